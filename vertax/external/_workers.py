"""Processes that run simulators: each does one thing at a time, and may hang or die by itself."""

from __future__ import annotations

import atexit
import multiprocessing
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import jax

from vertax.external._simulator import SimulatorError

Answer = TypeVar("Answer")


class _Worker:
    """A process that waits for work."""

    def __init__(self) -> None:
        # Forking a process in which JAX has threads may deadlock.
        context = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(1, context, initializer=_prepare)
        # (It takes seconds to begin, which are not those of the first thing that it does.)
        self.pool.submit(_nothing).result()

    def end(self) -> None:
        """End the process, whatever it does."""
        processes = list((getattr(self.pool, "_processes", None) or {}).values())
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


_IDLE: list[_Worker] = []
_LOCK = threading.Lock()


def elsewhere(job: Callable[[], Answer], timeout: float | None) -> Answer:
    """What a function returns that runs in another process.

    **Raises:**

    - `SimulatorError` if that dies, or is not done after `timeout` seconds; then it is ended.
    - Whatever the function raises.
    """
    with _LOCK:
        worker = _IDLE.pop() if _IDLE else None
    future: Future[Answer] | None = None
    try:
        worker = _Worker() if worker is None else worker
        future = worker.pool.submit(job)
        answer = future.result(timeout)
    except BrokenProcessPool as error:
        if worker is not None:
            worker.end()
        raise SimulatorError(
            "The process that ran the program died. If that was when it began: a script whose simulator "
            'runs in processes needs `if __name__ == "__main__":` around what it does.'
        ) from error
    except BaseException as error:
        late = isinstance(error, TimeoutError) and future is not None and not future.done()
        if worker is not None:
            # (What raised has done its work. What was interrupted has not.)
            _back(worker) if future is not None and future.done() else worker.end()
        if late:
            raise SimulatorError(
                f"The program was not done after {timeout:g} s, and its process was ended. If that is too "
                "short, raise `timeout`."
            ) from error
        raise
    _back(worker)
    return answer


def _back(worker: _Worker) -> None:
    with _LOCK:
        _IDLE.append(worker)


def _nothing() -> None:
    pass


def _prepare() -> None:
    """Leave the accelerator to the process that asks."""
    jax.config.update("jax_platforms", "cpu")


def _close() -> None:
    while _IDLE:
        _IDLE.pop().end()


atexit.register(_close)
