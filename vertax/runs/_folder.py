"""Folders of runs and their results."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, Shaped
from tqdm import tqdm

from vertax._base.archive import read_archive, write_archive
from vertax._base.extras import requires_extra
from vertax._base.results import RESULTS
from vertax.fitting import Checkpoint, Fit, FitError, InverseProblem, Record, doubts, fit
from vertax.io import atomic_write, save_tissue, write_csv
from vertax.mesh import Tissue
from vertax.runs._claim import (
    CONFIG,
    FAILED,
    FIGURES,
    METRICS,
    PARTS,
    claimed,
    existing,
    unfinished,
)
from vertax.runs._config import ExperimentConfig
from vertax.runs._errors import RunFolderError, UnfinishedRunError
from vertax.runs._figures import checked_formats, write_figure
from vertax.runs._summary import plain, safe, sentence
from vertax.runs._tables import histories, history_columns
from vertax.runs._versions import installed_version

with requires_extra("run", "The folder of a run"):
    import tomli_w
    from matplotlib.figure import Figure

Callback = Callable[[int, Record], Mapping[str, ArrayLike] | None]


class RunFolder:
    """A folder that holds the results of one run.

    `config.toml` is written first and `metrics.json` last: a folder with metrics is complete. Files are
    written atomically.

    **Arguments:**

    - `path`: an existing folder; `claim` finds or makes one.
    - `figures`: formats of the pictures, of `"png"`, `"pdf"` and `"svg"`; each picture is written in all
        of them.

    **Raises:**

    - `RunFolderError` for another format.
    """

    path: Path
    figure_formats: tuple[str, ...]
    talkative: bool
    """Whether `say` prints."""
    interrupted: bool
    """Whether a keyboard interrupt ended a fit of this run; no other one begins."""

    def __init__(self, path: str | os.PathLike[str], *, figures: Sequence[str] = ("png",)):
        self.path = Path(path)
        self.figure_formats = checked_formats(figures)
        self.talkative = False
        self.interrupted = False
        self._warnings: dict[str, list[str]] = {}

    @classmethod
    def claim(
        cls,
        name: str,
        output: str | os.PathLike[str] | None = None,
        *,
        overwrite: bool = False,
        root: str | os.PathLike[str] = "runs",
        figures: Sequence[str] = ("png",),
    ) -> RunFolder:
        """Make the folder of a new run, without touching an earlier one.

        **Arguments:**

        - `name`: of the run; its folder is `root/name` or, if that is taken, `root/name-2`, …
        - `output`: the folder itself, if the user chose one.
        - `overwrite`: clear a folder that holds an earlier run, and use it again.
        - `root`: folder of all runs.
        - `figures`: formats of the pictures.

        **Returns:** the folder, which holds no results.

        **Raises:**

        - `RunFolderError` if `output` is not empty and `overwrite` is not set, if what is to be
            overwritten is not the folder of a run, if a file is in the way, or for another format.
        """
        figures = checked_formats(figures)  # before anything is made or cleared
        return cls(claimed(Path(root) / name, output, overwrite), figures=figures)

    @classmethod
    def existing(cls, path: str | os.PathLike[str]) -> RunFolder:
        """The folder of an earlier run.

        **Arguments:**

        - `path`: the folder.

        **Returns:** the folder.

        **Raises:**

        - `RunFolderError` if there is no such folder, or if it is not that of a run.
        """
        return cls(existing(path))

    @classmethod
    def unfinished(
        cls,
        path: str | os.PathLike[str],
        config: ExperimentConfig,
        *,
        figures: Sequence[str] = ("png",),
    ) -> RunFolder:
        """The folder of an earlier run, to resume it.

        **Arguments:**

        - `path`: the folder.
        - `config`: the configuration, which must be that of the run.
        - `figures`: formats of the pictures; they may be others than before.

        **Returns:** the folder.

        **Raises:**

        - `RunFolderError` if it is not the folder of a run, if the run is finished, if its
            configuration is another one, or for another format.
        """
        return cls(unfinished(path, config), figures=figures)

    def say(self, what: str) -> None:
        """Print the current step of the run (`vertax run` without `--quiet`).

        **Arguments:**

        - `what`: a few words, for a step that takes more than two seconds.
        """
        if self.talkative:
            tqdm.write(f"  {what} …", file=sys.stderr)  # above the bars

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
            if self.interrupted:  # Ctrl-C reaches one thread only
                raise KeyboardInterrupt
            return None if callback is None else callback(epoch, record)

        if self.interrupted:
            raise KeyboardInterrupt
        if options.get("progress", True):  # concurrent fits share one progress bar
            self.say(f"fit: {name}")
        checkpoint = Checkpoint(self._part(name))
        try:
            outcome = fit(
                problem, optimiser, epochs, checkpoint=checkpoint, callback=watch, **options
            )
        except FitError as error:
            if error.fit is None:
                raise
            self._save_failed(name, error.fit)
            if not partial:
                raise
            self.warn(str(error).rstrip("."), name)
            return error.fit
        # With concurrent fits the flag is only ever set.
        interrupted = bool(np.any(outcome.result == RESULTS.interrupted))
        self.interrupted |= interrupted
        if not interrupted:
            self._judge(name, optimiser, epochs, outcome)
        return outcome

    def _judge(self, name: str, optimiser: Any, epochs: int, outcome: Fit[Any]) -> None:
        """Warn of a fit that has not converged."""
        for doubt in doubts(outcome):
            self.warn(doubt, name)
        solver = isinstance(optimiser, optx.AbstractLeastSquaresSolver)
        if solver and len(outcome.history.cost) >= epochs:
            self.warn(
                f"the least-squares solver did not end within {epochs} epochs (raise them)", name
            )

    def _save_failed(self, name: str, outcome: Fit[Any]) -> None:
        ending = safe(name)
        if outcome.history.cost.ndim == 1:
            self.save_table(f"history_{ending}", history_columns(outcome.history))
            self.save_tissue(f"fitted_{ending}", outcome.tissue)
        else:
            members = range(outcome.history.cost.shape[1])
            labels = [{"member": str(k)} for k in members]
            self.save_table(f"history_{ending}", histories(outcome, labels))

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

    def part(
        self, name: str, compute: Callable[[], Mapping[str, np.ndarray]]
    ) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Arrays that are stored for a resumed run.

        **Arguments:**

        - `name`: the name of this part, unique in the run.
        - `compute`: returns the arrays by name.

        **Returns:** the arrays.
        """
        file = self._part(name)
        if not file.exists():
            self.say(name)
            write_archive(file, "part", 1, compute())
        arrays = read_archive(file, "part", 1)
        return {key: array for key, array in arrays.items() if key not in ("format", "version")}

    def parts(self) -> list[Path]:
        """The fits and other parts that a resumed run keeps.

        **Returns:** the paths of their files, sorted by name.
        """
        return sorted(self.path.glob(f"{PARTS}/*.npz"))

    def forget_parts(self) -> None:
        """Remove them: the run is finished."""
        for file in self.parts():
            file.unlink()
        with contextlib.suppress(OSError):  # missing, or with other files
            (self.path / PARTS).rmdir()

    def _part(self, name: str) -> Path:
        folder = self.path / PARTS
        folder.mkdir(exist_ok=True)
        return folder / f"{safe(name)}.npz"

    def save_config(self, config: ExperimentConfig) -> None:
        """Write the resolved configuration, with every default spelled out.

        **Arguments:**

        - `config`: the configuration; `vertax run` on the written file repeats the run.
        """
        # TOML has no null: a key that is None by default is left out.
        content = config.model_dump(mode="json", exclude_none=True)
        programs = [f"{name} {installed_version(name)}" for name in ("vertax", "jax", "numpy")]
        with atomic_write(self.path / CONFIG) as file:
            file.write(f"# Run by {', '.join(programs)}; Python {platform.python_version()}.\n")
            file.write(tomli_w.dumps(content))

    def save_tissue(self, name: str, tissue: Tissue) -> None:
        """Write a tissue to `name.npz`.

        **Arguments:**

        - `name`: file name without ending.
        - `tissue`: the tissue.
        """
        save_tissue(self.path / f"{name}.npz", tissue)

    def save_array(self, name: str, array: Shaped[np.ndarray, "..."]) -> None:
        """Write an array to `name.npy`.

        **Arguments:**

        - `name`: file name without ending.
        - `array`: the array.
        """
        with atomic_write(self.path / f"{name}.npy", "wb") as file:
            np.save(file, array, allow_pickle=False)

    def save_table(self, name: str, columns: Mapping[str, Sequence[Any] | np.ndarray]) -> None:
        """Write a table to `name.csv`, as [`write_csv`][vertax.io.write_csv]: NaN is an empty field.

        **Arguments:**

        - `name`: file name without ending.
        - `columns`: entries by the name of the column, all of one length.

        **Raises:**

        - `ValueError` if the columns differ in length.
        """
        write_csv(self.path / f"{name}.csv", columns)

    def save_figure(self, name: str, figure: Figure) -> None:
        """Write a picture to `figures/name.png`, or in the other formats that were asked for.

        **Arguments:**

        - `name`: file name without ending.
        - `figure`: the Matplotlib figure.
        """
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        for ending in self.figure_formats:
            write_figure(folder / f"{name}.{ending}", figure)

    def save_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write the metrics; the last thing a run does.

        **Arguments:**

        - `metrics`: numbers, texts, lists and mappings; NaN and infinity, which strict JSON does
            not have, become null. `warnings` of this folder are added, if there are any.
        """
        if self.warnings:
            metrics = {**metrics, "warnings": self.warnings}
        with atomic_write(self.path / METRICS) as file:
            json.dump(plain(metrics), file, indent=2, allow_nan=False)
            file.write("\n")

    def finish(self, metrics: Mapping[str, Any]) -> None:
        """Finish the run: write its metrics and remove checkpoints.

        **Arguments:**

        - `metrics`: see `save_metrics`.

        **Raises:**

        - `KeyboardInterrupt` if a fit of the run was interrupted: then it is not finished.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        self.save_metrics(metrics)
        self.forget_parts()

    def discard_if_empty(self) -> None:
        """Remove the folder if it has only the configuration, so that the same command can be repeated."""
        if any(file != self.path / CONFIG for file in self.files()):
            return
        (self.path / CONFIG).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # in use, or not there
            for folder in (self.path / PARTS, self.path / "figures", self.path):
                if folder.is_dir():
                    folder.rmdir()

    def mark_failed(self, error: Exception) -> None:
        """Write the message of the error to `failed.txt`, unless the run can be resumed or left no files.

        The same command may then use the folder again.

        **Arguments:**

        - `error`: the error that ended the run.
        """
        if self.path.is_dir() and not self.parts():
            with atomic_write(self.path / FAILED) as file:
                file.write(f"{error}\n")

    def metrics(self) -> dict[str, Any]:
        """The metrics of a finished run.

        **Returns:** the metrics.

        **Raises:**

        - `UnfinishedRunError` if the run is not finished.
        - `RunFolderError` if the metrics cannot be read.
        """
        file = self.path / METRICS
        try:
            metrics = json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise UnfinishedRunError(
                f"The run in {self.path} is unfinished: it has no {METRICS}, which is written last. It is "
                f"still going, it was interrupted or it failed; to go on: vertax run {self.path / CONFIG} "
                f"--resume {self.path}"
            ) from None
        except ValueError as error:
            raise RunFolderError(f"{file} is no JSON ({error}).") from None
        if not isinstance(metrics, dict):
            raise RunFolderError(f"{file} is broken: it holds no metrics by name.")
        return metrics

    def files(self) -> list[Path]:
        """All files in the folder.

        **Returns:** their paths, sorted by name.
        """
        return sorted(file for file in self.path.rglob("*") if file.is_file())

    def figures(self) -> list[Path]:
        """The pictures written so far.

        **Returns:** their paths, sorted by name.
        """
        return sorted(file for pattern in FIGURES for file in self.path.glob(pattern))
