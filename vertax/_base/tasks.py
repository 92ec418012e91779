"""Many independent tasks on an executor of `concurrent.futures`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from typing import Any, NamedTuple

from tqdm import tqdm

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
    error, Ctrl-C), waiting tasks are cancelled.

    **Arguments:**

    - `function`: the function of one task. For processes and other machines it must be picklable, with its
        task and its result.
    - `tasks`: the tasks.
    - `executor`: any `concurrent.futures.Executor`, such as `client.get_executor()` of Dask,
        `mpi4py.futures.MPIPoolExecutor`, or threads. By default local processes, one per core, with one
        thread each; a script then needs `if __name__ == "__main__":` around its code.
    - `at_once`: largest number of tasks that wait or run.
    - `retries`: how often a task is repeated if its local process dies. (Dask repeats tasks by its settings.)
    - `progress`: show a progress bar (only on a terminal).
    - `unit`: unit of the progress bar.

    **Returns:** the number, the result and the error of each task, in the order in which they end.

    **Raises:**

    - `RuntimeError` if the executor no longer runs tasks: its scheduler or its processes died.
    """
    total = len(tasks) if hasattr(tasks, "__len__") else None  # pyright: ignore[reportArgumentType]
    remaining = enumerate(tasks)
    waiting: dict[Future[Any], tuple[int, Any, int]] = {}
    with contextlib.ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(LocalProcesses())
        bar = stack.enter_context(tqdm(total=total, unit=unit, disable=None if progress else True))
        stack.callback(lambda: [future.cancel() for future in waiting])
        while True:
            while len(waiting) < at_once and (following := next(remaining, None)) is not None:
                waiting[_submit(executor, function, *following)] = (*following, 0)
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                number, task, deaths = waiting.pop(future)
                value, error = _end(future)
                if isinstance(error, ProcessDied) and deaths < retries:
                    waiting[_submit(executor, function, number, task)] = (number, task, deaths + 1)
                    continue
                bar.update()
                yield Outcome(number, value, error)


_DEAD = (
    "The executor runs no more tasks ({error}): its scheduler or its processes died. Outcomes so far are "
    "complete; make a new executor and give it the tasks that are missing."
)


def _submit(executor: Executor, function: Callable[[Any], Any], number: int, task: Any) -> Future:
    try:
        return executor.submit(function, task)
    except BrokenExecutor as error:
        raise RuntimeError(_DEAD.format(error=type(error).__name__)) from error
    except (TypeError, AttributeError, ValueError) as error:  # of pickle
        raise TypeError(f"Task {number} cannot be sent to a worker: {error}") from error


def _end(future: Future[Any]) -> tuple[Any, Exception | None]:
    try:
        return future.result(), None
    except (BrokenExecutor, CancelledError) as error:
        raise RuntimeError(_DEAD.format(error=type(error).__name__)) from error
    except Exception as error:
        return None, error
