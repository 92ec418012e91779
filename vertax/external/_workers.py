"""Worker processes of simulators: each runs one job at a time, and can be killed."""

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

Result = TypeVar("Result")


class _Worker:
    """A process that runs jobs."""

    def __init__(self) -> None:
        # Forking a process in which JAX has threads may deadlock.
        context = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(1, context, initializer=_prepare)
        # (Wait for its start, which takes seconds, so that it does not count towards the first timeout.)
        self.pool.submit(_no_operation).result()

    def end(self) -> None:
        """Kill the process."""
        processes = list((getattr(self.pool, "_processes", None) or {}).values())
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


_IDLE: list[_Worker] = []
_LOCK = threading.Lock()


def run_in_process(job: Callable[[], Result], timeout: float | None) -> Result:
    """Run a function in another process and return its result.

    **Raises:**

    - `SimulatorError` if the process dies, or is killed after `timeout` seconds.
    - The exceptions of the function.
    """
    with _LOCK:
        worker = _IDLE.pop() if _IDLE else None
    future: Future[Result] | None = None
    try:
        worker = _Worker() if worker is None else worker
        future = worker.pool.submit(job)
        result = future.result(timeout)
    except BrokenProcessPool as error:
        if worker is not None:
            worker.end()
        raise SimulatorError(
            "The process that ran the program died. If it died at its start: a script with a simulator in "
            'processes needs `if __name__ == "__main__":` around its code.'
        ) from error
    except BaseException as error:
        timed_out = isinstance(error, TimeoutError) and future is not None and not future.done()
        if worker is not None:
            # (A job that raised an error is done, and its process free. An interrupted job is not.)
            _release(worker) if future is not None and future.done() else worker.end()
        if timed_out:
            raise SimulatorError(
                f"The program was not done after {timeout:g} s, and its process was killed. If that is too "
                "short, raise `timeout`."
            ) from error
        raise
    _release(worker)
    return result


def _release(worker: _Worker) -> None:
    with _LOCK:
        _IDLE.append(worker)


def _no_operation() -> None:
    pass


def _prepare() -> None:
    """Use the CPU, and leave the accelerator to the main process."""
    jax.config.update("jax_platforms", "cpu")


def _close() -> None:
    while _IDLE:
        _IDLE.pop().end()


atexit.register(_close)
