"""Independent runs in threads, one per core."""

from __future__ import annotations

import concurrent.futures
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import ArrayLike, Shaped
from tqdm import tqdm

from vertax.fitting import Fit, InverseProblem, Record, stack_fits
from vertax.runs._folder import RunFolder
from vertax.runs._sections import Fitting

Result = TypeVar("Result")


def side_by_side(
    function: Callable[[int], Result],
    n: int,
    folder: RunFolder,
    *,
    progress: bool = True,
    unit: str = "run",
) -> list[Result]:
    """Call a function for each of 0 … n - 1 in threads, one per core.

    Compiled functions of JAX release Python's lock, so threads are enough. The first call runs alone, because
    it compiles. A keyboard interrupt reaches one thread only; here it ends all: fits of the folder stop after
    their epoch and are kept, other calls run to their end, and no other call begins.

    **Arguments:**

    - `function`: the function; calls must not share state.
    - `n`: number of calls.
    - `folder`: the folder of the run, which records interrupts.
    - `progress`: show a progress bar (only on a terminal).
    - `unit`: unit of the progress bar.

    **Returns:** the results, in the order of the numbers.

    **Raises:**

    - `KeyboardInterrupt` if the run was interrupted before all of them began.
    - what a call raises; those that go on are waited for, and nothing else begins.
    """

    def one(index: int) -> Result:
        if folder.interrupted:
            raise KeyboardInterrupt
        return function(index)

    results: dict[int, Result] = {}
    with tqdm(total=n, unit=unit, disable=None if progress else True) as bar:
        for index in range(min(n, 1)):
            results[index] = one(index)
            bar.update()
        with concurrent.futures.ThreadPoolExecutor(n_threads()) as pool:
            waiting = {pool.submit(one, index): index for index in range(1, n)}
            try:
                for done in concurrent.futures.as_completed(waiting):
                    results[waiting[done]] = done.result()
                    bar.update()
            except BaseException as error:
                folder.interrupted |= isinstance(error, KeyboardInterrupt)
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return [results[index] for index in range(n)]


def scan(
    name: str,
    values: Sequence[float],
    compute: Callable[[float], Mapping[str, np.ndarray]],
    folder: RunFolder,
    *,
    progress: bool = True,
) -> dict[str, Shaped[np.ndarray, "values ..."]]:
    """Arrays at each of several values of a parameter; a resumed run keeps those that are computed.

    **Arguments:**

    - `name`: the name of the parameter, and of the parts of the run.
    - `values`: its values, all different.
    - `compute`: returns the arrays at one value by name; their shapes are the same at all values.
    - `folder`: the folder of the run.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the arrays by name, with a leading axis of the values.
    """

    def one(index: int) -> dict[str, np.ndarray]:
        value = float(values[index])
        return folder.part(f"{name} {value:g}", lambda: compute(value))

    results = side_by_side(one, len(values), folder, progress=progress, unit="value")
    return {key: np.stack([result[key] for result in results]) for key in results[0]}


def fit_side_by_side(
    folder: RunFolder,
    name: str,
    problems: Sequence[InverseProblem[Any]],
    fitting: Fitting,
    *,
    notes: Callable[[InverseProblem[Any], Record], Mapping[str, ArrayLike]] | None = None,
    progress: bool = True,
) -> Fit[Any]:
    """Fit problems of one shape in threads.

    In a batch each epoch takes as many steps as its slowest relaxation, which with T1 transitions is many
    times the median.

    **Arguments:**

    - `folder`: the folder of the run.
    - `name`: the name of these fits; they are numbered from 0.
    - `problems`: the inverse problems.
    - `fitting`: optimiser and epochs.
    - `notes`: returns arrays to keep from each epoch, as a function of its problem and its
        [`Record`][vertax.Record].
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the fits as one batch, with notes; seconds are their sum over the number of threads.

    **Raises:**

    - `FitError` if a fit fails.
    """

    def one(index: int) -> Fit[Any]:
        problem = problems[index]

        def noted(epoch: int, record: Record) -> Mapping[str, ArrayLike] | None:
            return None if notes is None else notes(problem, record)

        optimiser, epochs = fitting.build(), fitting.epochs
        return folder.fit(
            f"{name} {index}", problem, optimiser, epochs, callback=noted, progress=False
        )

    fits = side_by_side(one, len(problems), folder, progress=progress, unit="fit")
    return stack_fits(fits, at_once=n_threads())


THREADS = "VERTAX_THREADS"
"""The environment variable with the number of concurrent runs."""


def n_threads() -> int:
    """The number of concurrent runs: the environment variable, or one per core."""
    number = os.environ.get(THREADS, "")
    return max(int(number), 1) if number.isdecimal() else os.cpu_count() or 1
