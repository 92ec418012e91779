"""Many independent tasks on an executor of `concurrent.futures`."""

from __future__ import annotations

import contextlib
import importlib
import pickle
import uuid
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from typing import Any, NamedTuple

import jax
from tqdm import tqdm

from vertax._base.compilation_cache import enable_compilation_cache
from vertax._base.processes import LocalProcesses, ProcessDied


class Outcome(NamedTuple):
    """The end of a task."""

    number: int
    """The number of the task, from 0."""
    value: Any
    """The result; None if the task failed."""
    error: Exception | None
    """The error of a task that failed."""


def map_tasks(
    function: Callable[[Any], Any],
    tasks: Iterable[Any],
    *,
    executor: Executor | None = None,
    at_once: int = 256,
    result_limit: int = 2**30,
    retries: int = 1,
    progress: bool = True,
    unit: str = "task",
) -> Generator[Outcome, None, None]:
    """Call a function for each of many independent tasks, on the workers of an executor.

    ```python
    for number, value, error in vx.map_tasks(function, tasks, executor=client.get_executor()):
        ...  # as they end: write the result, or the error
    ```

    A task that fails does not end the others. At most `at_once` tasks wait or run at a time, so neither tasks
    nor results accumulate in memory if the caller does not keep them. When the caller stops (`break`, an
    error, Ctrl-C), waiting tasks are cancelled. Other processes compute in the precision of this one.

    **Arguments:**

    - `function`: the function of one task. For processes and other machines it must be picklable, with its
        task and its result.
    - `tasks`: the tasks.
    - `executor`: any `concurrent.futures.Executor`, such as `client.get_executor()` of Dask,
        `mpi4py.futures.MPIPoolExecutor`, or threads. By default local processes, one per core, with one
        thread each; a script then needs `if __name__ == "__main__":` around its code.
    - `at_once`: largest number of tasks that wait or run.
    - `result_limit`: largest size of a result of another process, in bytes; a larger one is an error.
    - `retries`: how often a task is repeated if its process dies: after all others, alone, when it has most
        memory. (Before that, Dask repeats it three times, as its neighbour in the queue of that worker.)
    - `progress`: show a progress bar (only on a terminal).
    - `unit`: unit of the progress bar.

    **Returns:** the number, the result and the error of each task, in the order in which they end.

    **Raises:**

    - `RuntimeError` if the executor no longer runs tasks: its scheduler or its processes died. It comes after
        all results that have arrived.
    """
    total = len(tasks) if hasattr(tasks, "__len__") else None  # pyright: ignore[reportArgumentType]
    remaining = ((number, task, 0) for number, task in enumerate(tasks))
    waiting: dict[Future[Any], tuple[int, Any, int]] = {}
    repeated: list[tuple[int, Any, int]] = []
    dead: BaseException | None = None
    with contextlib.ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(LocalProcesses())
        remote = not isinstance(executor, ThreadPoolExecutor) or isinstance(
            executor, LocalProcesses
        )
        cached = jax.config.values["jax_compilation_cache_dir"] is not None
        settings = jax.config.values["jax_enable_x64"], cached, result_limit
        dask = getattr(executor, "_client", None)
        dumps = importlib.import_module("cloudpickle" if dask else "pickle").dumps
        name, group = str(dask or type(executor).__name__), uuid.uuid4().hex
        bar = stack.enter_context(tqdm(total=total, unit=unit, disable=None if progress else True))
        stack.callback(lambda: [future.cancel() for future in waiting])
        while True:
            while dead is None and len(waiting) < at_once:
                new = next(remaining, None) or (
                    repeated.pop() if repeated and not waiting else None
                )
                if new is None:
                    break
                number, task, deaths = new
                # By this key, equal tasks of Dask are not one task, and queue at the scheduler.
                key = {"key": (f"task-{group}", number, deaths)} if dask else {}
                try:
                    call: Any = (
                        (_run, dumps((function, task)), *settings) if remote else (function, task)
                    )
                except Exception as error:  # pickle raises errors of many types
                    text = f"Task {number} cannot be sent to a worker, by pickle: {error}"
                    yield Outcome(number, None, TypeError(text))
                    continue
                try:
                    waiting[executor.submit(*call, **key)] = new
                except BrokenExecutor as error:
                    dead = error
            # (Of a dead executor, results that have arrived come before the error.)
            done = wait(waiting, None if dead is None else 0, FIRST_COMPLETED).done
            if not done:
                break
            for future in done:
                number, task, deaths = waiting.pop(future)
                error = None if future.cancelled() else future.exception()
                if error is not None and not isinstance(error, Exception):  # Ctrl-C in a thread
                    raise error
                if future.cancelled() or isinstance(error, BrokenExecutor):
                    dead = error or CancelledError()
                    continue
                if type(error).__name__ == "KilledWorker":  # of Dask
                    error = ProcessDied()
                if isinstance(error, ProcessDied) and deaths < retries:
                    repeated.append((number, task, deaths + 1))
                    continue
                bar.update()
                yield Outcome(number, future.result() if error is None else None, error)
    if dead is not None:
        raise RuntimeError(
            f"The executor {name} runs no more tasks ({type(dead).__name__}): its scheduler or its processes "
            "died. Outcomes so far are complete; make a new executor and give it the tasks that are missing."
        ) from dead


def _run(content: bytes, x64: bool, cached: bool, limit: int) -> Any:
    """Run a task in another process, with the precision and the compilation cache of the caller."""
    jax.config.update("jax_enable_x64", x64)  # before arrays are unpickled, which it may round
    if cached:
        enable_compilation_cache()
    function, task = pickle.loads(content)
    try:
        return _checked(function(task), limit)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            text = f"{type(error).__name__}: {error}"
        else:
            raise
    raise RuntimeError(text)  # in place of an error that would end the process that receives it


def _checked(result: Any, limit: int) -> Any:
    size, buffers = 0, []
    with contextlib.suppress(Exception):  # some executors send what `pickle` does not
        size = len(pickle.dumps(result, 5, buffer_callback=buffers.append))
    size += sum(buffer.raw().nbytes for buffer in buffers)
    if size > limit:
        raise ValueError(
            f"The result has {size / 2**20:.3g} MiB, more than {limit / 2**20:.3g} MiB. Return less, write a "
            "file in the task, or raise `result_limit` of map_tasks."
        )
    return result
