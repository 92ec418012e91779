"""Local worker processes: each runs one task at a time, and can be killed."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any, TypeVar

from vertax._base.threads import THREADS, num_threads

Result = TypeVar("Result")


class ProcessDied(RuntimeError):
    """The process of a task ended before the task."""

    def __init__(self) -> None:
        super().__init__("its process died, perhaps for lack of memory")


class ProcessKilled(RuntimeError):
    """The process of a task was killed, because its time was over."""


class LocalProcesses(ThreadPoolExecutor):
    """An executor of local processes with one thread each. A process that dies ends its task only.

    A script that uses it needs `if __name__ == "__main__":` around its code.

    **Arguments:**

    - `workers`: number of processes, by default one per core.
    """

    def __init__(self, workers: int | None = None):
        super().__init__(workers or num_threads())

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a function, which must be picklable with its arguments, in one of the processes."""
        return super().submit(run_in_process, partial(fn, *args, **kwargs))


class _Worker:
    """A process that runs tasks."""

    def __init__(self) -> None:
        # Forking a process in which JAX has threads may deadlock.
        context = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(1, context, initializer=_prepare)
        # (Wait for its start, which takes seconds, so that it does not count towards the first timeout.)
        self.pool.submit(os.getcwd).result()

    def end(self) -> None:
        """Kill the process."""
        processes = list((getattr(self.pool, "_processes", None) or {}).values())
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


_IDLE: list[_Worker] = []
_LOCK = threading.Lock()


def run_in_process(task: Callable[[], Result], timeout: float | None = None) -> Result:
    """Run a function in another process and return its result. Idle processes are used again.

    **Raises:**

    - `ProcessDied` if the process dies, and `ProcessKilled` if it is killed after `timeout` seconds.
    - The exceptions of the function.
    """
    with _LOCK:
        worker = _IDLE.pop() if _IDLE else None
    future: Future[Result] | None = None
    try:
        worker = _Worker() if worker is None else worker
        future = worker.pool.submit(_in_folder, os.getcwd(), task)
        result = future.result(timeout)
    except BrokenProcessPool as error:
        if worker is not None:
            worker.end()
        raise ProcessDied from error
    except BaseException as error:
        timed_out = isinstance(error, TimeoutError) and future is not None and not future.done()
        if worker is not None:
            # (A task that raised an error is done, and its process free. An interrupted task is not.)
            _release(worker) if future is not None and future.done() else worker.end()
        if timed_out:
            raise ProcessKilled from error
        raise
    _release(worker)
    return result


def _release(worker: _Worker) -> None:
    with _LOCK:
        _IDLE.append(worker)


def _in_folder(folder: str, task: Callable[[], Result]) -> Result:
    os.chdir(folder)  # that of the caller, which may have changed since the process began
    return task()


def _prepare() -> None:
    os.environ[THREADS] = "1"  # the other cores belong to the other processes
    os.environ["NPROC"] = "1"  # the number of threads of XLA
    parent = multiprocessing.parent_process()
    if parent is not None:  # end with the parent, also if that is killed
        end = lambda: (parent.join(), os._exit(1))
        threading.Thread(target=end, daemon=True).start()


def _close() -> None:
    while _IDLE:
        _IDLE.pop().end()


atexit.register(_close)
