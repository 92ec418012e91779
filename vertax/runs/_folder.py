"""The folder of a run: its fits, concurrent computations, and results."""

from __future__ import annotations

import concurrent.futures
import contextlib
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, Shaped
from tqdm import tqdm

from vertax._base.archive import read_archive, write_archive
from vertax._base.atomic import atomic_write
from vertax._base.extras import requires_extra
from vertax._base.results import RESULTS
from vertax._base.tasks import map_tasks
from vertax._base.threads import num_threads
from vertax.fitting import (
    Checkpoint,
    Fit,
    FitError,
    InverseProblem,
    Record,
    fit,
    fit_warnings,
    stack_fits,
)
from vertax.io import save, write_csv
from vertax.mesh import Tissue
from vertax.runs._sections import Fitting
from vertax.runs._tables import file_name, history_table, plain, sentence

with requires_extra("run", "The folder of a run"):
    import matplotlib
    from matplotlib.figure import Figure

METRICS, PARTS = "metrics.json", "unfinished"
# Reproducible files, and text in a PDF as text.
_UNDATED: dict[str, dict[str, None]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
_VECTOR_STYLE: Any = {"pdf.fonttype": 42, "svg.hashsalt": "vertax"}

Callback = Callable[[int, Record], Mapping[str, ArrayLike] | None]
Notes = Callable[[InverseProblem[Any], Record], Mapping[str, ArrayLike]]
Result = TypeVar("Result")


class RunFolderError(ValueError):
    """A folder that a run must not overwrite, or without a run."""


class RunFolder:
    """A folder that holds the results of one run.

    `config.toml` is written first and `metrics.json` last: a folder with metrics is complete. Files are
    written atomically.

    **Arguments:**

    - `path`: an existing folder.
    - `figures`: formats of the pictures, of `"png"`, `"pdf"` and `"svg"`; each picture is written in all
        of them.
    - `print_steps`: whether `print_step` prints.
    - `executor`: workers (of `--workers`, `--scheduler` or `--cluster`) for [`map_tasks`][vertax.map_tasks].
    """

    interrupted: bool
    """Whether a keyboard interrupt ended a fit of this run; no other one begins."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        figures: Sequence[str] = ("png",),
        print_steps: bool = False,
        executor: concurrent.futures.Executor | None = None,
    ):
        self.path = Path(path)
        self.figure_formats = tuple(figures)
        self.interrupted = False
        self.executor = executor
        self._print_steps = print_steps
        self._warnings: dict[str, list[str]] = {}

    @property
    def parts(self) -> Path:
        """The folder of archives (`.npz`) that a resumed run keeps; the end of the run removes them."""
        return self.path / PARTS

    def print_step(self, step: str) -> None:
        """Print the current step of the run (`vertax run` without `--quiet`).

        **Arguments:**

        - `step`: a few words, for a step that takes more than two seconds.
        """
        if self._print_steps:
            tqdm.write(f"  {step} …", file=sys.stderr)  # above the bars

    def fit(
        self,
        name: str,
        problem: InverseProblem[Any],
        optimiser: Any,
        epochs: int,
        *,
        partial: bool = False,
        callback: Callback | None = None,
        **options: Any,
    ) -> Fit[Any]:
        """Solve an inverse problem, with a checkpoint in this folder for a resumed run.

        A fit that has not converged adds to `warnings`. A fit that fails leaves the table of its epochs and,
        if it is not a batch, its best tissue, both named after it.

        **Arguments:**

        - `name`: the name of this fit, unique in the run.
        - `problem`, `optimiser`, `epochs`, `callback`, `options`: as of [`fit`][vertax.fit].
        - `partial`: return the epochs of a fit that fails, with a warning.

        **Returns:** the [`Fit`][vertax.Fit], also after an interrupt, which sets `interrupted` of the folder.

        **Raises:**

        - `KeyboardInterrupt` if an earlier fit was interrupted, or this one before its first epoch.
        - `FitError` if it fails and `partial` is not set, or before its first epoch.
        - others as [`fit`][vertax.fit].
        """

        def watch(epoch: int, record: Record) -> Mapping[str, ArrayLike] | None:
            self._check_interrupt()
            return None if callback is None else callback(epoch, record)

        self._check_interrupt()
        if options.get("progress", True):  # concurrent fits share one progress bar
            self.print_step(f"fit: {name}")
        options |= {"checkpoint": Checkpoint(self._part_file(name)), "callback": watch}
        try:
            outcome = fit(problem, optimiser, epochs, **options)
        except FitError as error:
            if error.fit is None:
                raise
            self._save_failed(file_name(name), error.fit)
            if not partial:
                raise
            self.warn(str(error).rstrip("."), name)
            return error.fit
        interrupted = bool(np.any(outcome.result == RESULTS.interrupted))
        self.interrupted |= interrupted  # fits in other threads never reset it
        if interrupted:
            return outcome
        for warning in fit_warnings(outcome):
            self.warn(warning, name)
        solver = isinstance(optimiser, optx.AbstractLeastSquaresSolver)
        if solver and len(outcome.history.cost) >= epochs:
            text = f"the least-squares solver did not end within {epochs} epochs (raise them)"
            self.warn(text, name)
        return outcome

    def fit_in_threads(
        self,
        name: str,
        problems: Sequence[InverseProblem[Any]],
        fitting: Fitting,
        *,
        notes: Notes | None = None,
        progress: bool = True,
    ) -> Fit[Any]:
        """Fit problems of one shape in threads, or on the workers of the run.

        In a batch each epoch takes as many steps as its slowest relaxation, which with T1 transitions is many
        times the median.

        **Arguments:**

        - `name`: the name of these fits; they are numbered from 0.
        - `problems`: the inverse problems.
        - `fitting`: optimiser and epochs.
        - `notes`: returns arrays to keep from each epoch, as a function of its problem and its
            [`Record`][vertax.Record].
        - `progress`: show a progress bar (only on a terminal).

        **Returns:** the fits as one batch, with notes; seconds are their sum over the number of threads.

        **Raises:** as `fit` and `map_in_threads`.
        """
        names = [f"{name} {index}" for index in range(len(problems))]
        options: dict[str, Any] = {"progress": progress, "unit": "fit"}
        if self.executor is not None:  # workers send checkpoints of finished fits
            tasks = [
                t for t in zip(names, problems, strict=True) if not self._part_file(t[0]).exists()
            ]
            call = partial(_checkpoint, fitting=fitting, notes=notes)
            for number, content in self._map(call, tasks, self.executor, **options):
                with atomic_write(self._part_file(tasks[number][0]), "wb") as file:
                    file.write(content)

        def fit_one(index: int) -> Fit[Any]:
            watch: Any = (compute := notes) and (lambda _, record: compute(problems[index], record))
            arguments = problems[index], fitting.build(), fitting.epochs
            return self.fit(names[index], *arguments, callback=watch, progress=False)

        fits = self.map_in_threads(fit_one, len(names), **options)
        return stack_fits(fits, at_once=num_threads())

    def map_in_threads(
        self, function: Callable[[int], Result], n: int, *, progress: bool = True, unit: str = "run"
    ) -> list[Result]:
        """Call a function for each of 0 … n - 1 in threads, one per core.

        Compiled functions of JAX release Python's lock. The first call runs alone, because it compiles. After
        a keyboard interrupt, fits of this folder stop after their epoch and are kept, other calls run to
        their end, and no other call begins.

        **Arguments:**

        - `function`: the function; calls must not share state.
        - `n`: number of calls.
        - `progress`: show a progress bar (only on a terminal).
        - `unit`: unit of the progress bar.

        **Returns:** the results, in the order of the numbers.

        **Raises:**

        - `KeyboardInterrupt` if the run was interrupted before all of them began.
        - the error of a call, after the calls that have begun; no other call begins.
        """

        def call(index: int) -> Result:
            self._check_interrupt()
            return function(index)

        results = dict(self._map(call, range(n), None, progress=progress, unit=unit))
        return [results[index] for index in range(n)]

    def map_parts(
        self,
        compute: Callable[[Any], Mapping[str, np.ndarray]],
        tasks: Mapping[str, Any],
        *,
        progress: bool = True,
        unit: str = "part",
    ) -> dict[str, dict[str, Shaped[np.ndarray, "..."]]]:
        """Arrays of many tasks, such as replicates, from the workers of the run or else from threads.

        **Arguments:**

        - `compute`: returns the arrays of a task by name; picklable, such as a function of a module.
        - `tasks`: the tasks by unique names; a resumed run keeps those that are computed.
        - `progress`, `unit`: as of `map_in_threads`.

        **Returns:** the arrays of each task by name.

        **Raises:** as `map_in_threads`.
        """
        missing = [name for name in tasks if not self._part_file(name).exists()]
        values = [tasks[name] for name in missing]
        options: Any = {"progress": progress, "unit": unit}
        for number, arrays in self._map(compute, values, self.executor, **options):
            write_archive(self._part_file(missing[number]), "part", 1, arrays)
        return {name: self.part(name, dict) for name in tasks}

    def _map(
        self, function: Callable[[Any], Result], tasks: Sequence[Any], executor: Any, **options: Any
    ) -> Iterator[tuple[int, Result]]:
        """Number and result of each task, as they end; in threads the first one runs alone."""
        first = 1 if executor is None else 0
        threads = concurrent.futures.ThreadPoolExecutor
        with contextlib.nullcontext(executor) if executor else threads(num_threads()) as pool:
            try:
                for begin, some in ((0, tasks[:first]), (first, tasks[first:])):
                    outcomes = map_tasks(function, some, executor=pool, **options)
                    with contextlib.closing(outcomes):
                        for number, value, error in outcomes:
                            if error is not None:
                                raise error
                            yield begin + number, value
            except KeyboardInterrupt:
                self.interrupted = True
                raise

    def part(
        self, name: str, compute: Callable[[], Mapping[str, np.ndarray]]
    ) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Arrays that are stored for a resumed run.

        A resumed run compares its configuration, not the code of `compute`: after a change of the code run
        with `--overwrite`, or delete the file of the part.

        **Arguments:**

        - `name`: the name of this part, unique in the run.
        - `compute`: returns the arrays by name.

        **Returns:** the arrays.
        """
        file = self._part_file(name)
        if not file.exists():
            self.print_step(name)
            write_archive(file, "part", 1, compute())
        arrays = read_archive(file, "part", 1)
        return {key: array for key, array in arrays.items() if key not in ("format", "version")}

    def warn(self, text: str, name: str | None = None) -> None:
        """Add a warning, which is printed and part of the metrics.

        **Arguments:**

        - `text`: a sentence without a full stop.
        - `name`: its subject, such as the name of a fit; equal texts are joined.
        """
        self._warnings.setdefault(text, []).extend([] if name is None else [name])

    @property
    def warnings(self) -> list[str]:
        """The warnings, one sentence each."""
        return [sentence(text, sorted(names)) for text, names in self._warnings.items()]

    def save_tissue(self, name: str, tissue: Tissue) -> None:
        """Write a tissue to `name.npz`."""
        save(self.path / f"{name}.npz", tissue)

    def save_array(self, name: str, array: Shaped[np.ndarray, "..."]) -> None:
        """Write an array to `name.npy`."""
        with atomic_write(self.path / f"{name}.npy", "wb") as file:
            np.save(file, array, allow_pickle=False)

    def save_table(self, name: str, columns: Mapping[str, Sequence[Any] | np.ndarray]) -> None:
        """Write columns of one length to `name.csv`, as [`write_csv`][vertax.io.write_csv]."""
        write_csv(self.path / f"{name}.csv", columns)

    def save_figure(self, name: str, figure: Figure) -> None:
        """Write a Matplotlib figure to `figures/name.png`, or in the other formats of this folder."""
        (self.path / "figures").mkdir(exist_ok=True)
        for ending in self.figure_formats:
            path = self.path / "figures" / f"{name}.{ending}"
            with matplotlib.rc_context(_VECTOR_STYLE), atomic_write(path, "wb") as file:
                figure.savefig(file, format=ending, dpi=200, metadata=_UNDATED.get(ending))

    def save_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write the metrics and the warnings; NaN and infinity, which JSON does not have, become null."""
        if self.warnings:
            metrics = {**metrics, "warnings": self.warnings}
        with atomic_write(self.path / METRICS) as file:
            json.dump(plain(metrics), file, indent=2, allow_nan=False)
            file.write("\n")

    def _check_interrupt(self) -> None:
        if self.interrupted:  # Ctrl-C reaches one thread only
            raise KeyboardInterrupt

    def _part_file(self, name: str) -> Path:
        self.parts.mkdir(exist_ok=True)
        return self.parts / f"{file_name(name)}.npz"

    def _save_failed(self, name: str, outcome: Fit[Any]) -> None:
        self.save_table(f"history_{name}", history_table(outcome.history))
        if outcome.history.cost.ndim == 1:
            self.save_tissue(f"fitted_{name}", outcome.tissue)


def _checkpoint(
    task: tuple[str, InverseProblem[Any]], fitting: Fitting, notes: Notes | None
) -> bytes:
    """The checkpoint of a finished fit, from a worker."""
    name, problem = task
    with tempfile.TemporaryDirectory() as path:
        folder = RunFolder(path)
        folder.fit_in_threads(name, [problem], fitting, notes=notes, progress=False)
        return folder._part_file(f"{name} 0").read_bytes()
