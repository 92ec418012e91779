"""Run folders: where an experiment leaves its results."""

from __future__ import annotations

import contextlib
import csv
import importlib.metadata
import json
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from jaxtyping import Shaped
from matplotlib.figure import Figure

from vertax._base.archive import read_archive, write_archive
from vertax.fitting import Checkpoint, Fit, InverseProblem, fit
from vertax.io import atomic_write, save_tissue
from vertax.mesh import Tissue
from vertax.runs._config import ExperimentConfig, read_toml, validate
from vertax.runs._summary import plain

CONFIG, METRICS, PARTS = "config.toml", "metrics.json", "unfinished"
# What a run may have left behind; METRICS goes first, so that a folder which holds it is complete.
_LEFTOVERS = (METRICS, "*.csv", "*.npz", "*.npy", "figures/*.png", f"{PARTS}/*.npz")


class RunFolderError(ValueError):
    """A folder that a run must not write to, or that holds none."""


class UnfinishedRunError(RunFolderError):
    """The folder of a run that did not come to its end."""


class RunFolder:
    """A folder that holds the results of one run.

    `config.toml` is written first and `metrics.json` last: a folder with metrics is complete. Every
    file appears under its name only when it is complete.

    **Arguments:**

    - `path`: an existing folder; `claim` finds or makes one.
    """

    path: Path
    interrupted: bool
    """Whether an interrupt from the keyboard ended a fit of this run: no other one begins."""

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.interrupted = False

    @classmethod
    def claim(
        cls,
        name: str,
        output: str | os.PathLike[str] | None = None,
        *,
        overwrite: bool = False,
        root: str | os.PathLike[str] = "runs",
    ) -> RunFolder:
        """Make the folder of a new run, without touching an earlier one.

        **Arguments:**

        - `name`: of the run; its folder is `root/name` or, if that is taken, `root/name-2`, …
        - `output`: the folder itself, if the user chose one.
        - `overwrite`: clear a folder that holds an earlier run, and use it again.
        - `root`: folder of all runs.

        **Returns:** the folder, which holds no results.

        **Raises:**

        - `RunFolderError` if `output` is not empty and `overwrite` is not set, if what is to be
            overwritten is not the folder of a run, or if a file is in the way.
        """
        try:
            if output is None and not overwrite:
                return cls(_numbered(Path(root) / name))
            folder = Path(root) / name if output is None else Path(output)
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                if not overwrite:
                    raise RunFolderError(
                        f"The folder {folder} is not empty. Choose another with --output, or pass "
                        "--overwrite to replace the run in it."
                    )
                _clear(folder)
        except (FileExistsError, NotADirectoryError) as error:
            raise RunFolderError(
                f"Cannot use {error.filename} as a folder: there is a file of that name."
            ) from None
        return cls(folder)

    @classmethod
    def existing(cls, path: str | os.PathLike[str]) -> RunFolder:
        """The folder of an earlier run.

        **Arguments:**

        - `path`: the folder.

        **Returns:** the folder.

        **Raises:**

        - `RunFolderError` if there is no such folder, or if it is not that of a run.
        """
        folder = Path(path)
        if not folder.is_dir():
            what = "it is a file" if folder.exists() else "there is none"
            raise RunFolderError(f"{folder} is not the folder of a run: {what}.")
        if not (folder / CONFIG).is_file():
            raise RunFolderError(
                f"{folder} is not the folder of a run: there is no {CONFIG} in it, which a run writes first."
            )
        return cls(folder)

    @classmethod
    def unfinished(cls, path: str | os.PathLike[str], config: ExperimentConfig) -> RunFolder:
        """The folder of an earlier run that did not come to its end, to go on with it.

        **Arguments:**

        - `path`: the folder.
        - `config`: the configuration, which must be that of the run.

        **Returns:** the folder.

        **Raises:**

        - `RunFolderError` if it is not the folder of a run, if the run is finished, or if its
            configuration is another one.
        """
        run = cls.existing(path)
        if (run.path / METRICS).exists():
            raise RunFolderError(
                f"The run in {run.path} is finished: there is nothing to resume. To see what it found: "
                f"vertax show {run.path}"
            )
        earlier = read_toml(run.path / CONFIG)
        if earlier.get("experiment") != (config.model_dump().get("experiment")):
            raise RunFolderError(
                f"The run in {run.path} is one of the experiment {earlier.get('experiment')!r}. Give its "
                f"own configuration: vertax run {run.path / CONFIG} --resume {run.path}"
            )
        then = validate(type(config), earlier, str(run.path / CONFIG))
        if then != config:
            changed = _changes(then.model_dump(mode="json"), config.model_dump(mode="json"))
            raise RunFolderError(
                f"The run in {run.path} has another configuration: {'; '.join(changed)}. Give its own, "
                f"vertax run {run.path / CONFIG} --resume {run.path}, or begin a new run without --resume."
            )
        return run

    def fit(
        self, name: str, problem: InverseProblem[Any], optimiser: Any, epochs: int, **options: Any
    ) -> Fit[Any]:
        """Solve an inverse problem, with a checkpoint in this folder that a resumed run goes on from.

        **Arguments:**

        - `name`: of this fit; no other one of the run has it.
        - `problem`, `optimiser`, `epochs`, `options`: as of [`fit`][vertax.fit].

        **Returns:** the [`Fit`][vertax.Fit], also if it was interrupted; `interrupted` of the folder then
        tells so.

        **Raises:**

        - `KeyboardInterrupt` if an earlier fit was interrupted, or this one before it had anything.
        - others as [`fit`][vertax.fit].
        """
        if self.interrupted:
            raise KeyboardInterrupt
        checkpoint = Checkpoint(self._part(name))
        outcome = fit(problem, optimiser, epochs, checkpoint=checkpoint, **options)
        self.interrupted = outcome.interrupted
        return outcome

    def part(
        self, name: str, compute: Callable[[], Mapping[str, np.ndarray]]
    ) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Arrays that a resumed run does not compute again.

        **Arguments:**

        - `name`: of this part; no other part or fit of the run has it.
        - `compute`: makes the arrays, by name.

        **Returns:** the arrays.
        """
        file = self._part(name)
        if not file.exists():
            write_archive(file, "part", 1, compute())
        arrays = read_archive(file, "part", 1)
        return {key: array for key, array in arrays.items() if key not in ("format", "version")}

    def parts(self) -> list[Path]:
        """The fits and other parts that a resumed run goes on from.

        **Returns:** the paths of their files, sorted by name.
        """
        return sorted(self.path.glob(f"{PARTS}/*.npz"))

    def forget_parts(self) -> None:
        """Remove them: the run is finished."""
        for file in self.parts():
            file.unlink()
        with contextlib.suppress(OSError):  # not there, or a file of somebody else in it
            (self.path / PARTS).rmdir()

    def _part(self, name: str) -> Path:
        folder = self.path / PARTS
        folder.mkdir(exist_ok=True)
        return folder / f"{re.sub('[^0-9A-Za-z.-]+', '_', name)}.npz"

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
        """Write a table to `name.csv`.

        **Arguments:**

        - `name`: file name without ending.
        - `columns`: entries by the name of the column, all of one length.

        **Raises:**

        - `ValueError` if the columns differ in length.
        """
        rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
        with atomic_write(self.path / f"{name}.csv", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)

    def save_figure(self, name: str, figure: Figure) -> None:
        """Write a picture to `figures/name.png`.

        **Arguments:**

        - `name`: file name without ending.
        - `figure`: the Matplotlib figure.
        """
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        with atomic_write(folder / f"{name}.png", "wb") as file:
            figure.savefig(file, format="png", dpi=200)

    def save_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write the metrics; the last thing a run does.

        **Arguments:**

        - `metrics`: numbers, texts, lists and mappings; NaN and infinity, which strict JSON does
            not have, become null.
        """
        with atomic_write(self.path / METRICS) as file:
            json.dump(plain(metrics), file, indent=2, allow_nan=False)
            file.write("\n")

    def metrics(self) -> dict[str, Any]:
        """The metrics of a finished run.

        **Returns:** what was given to `save_metrics`.

        **Raises:**

        - `UnfinishedRunError` if the run did not come to its end.
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
        """All files, those of other programs too.

        **Returns:** their paths, sorted by name.
        """
        return sorted(file for file in self.path.rglob("*") if file.is_file())

    def figures(self) -> list[Path]:
        """The pictures written so far.

        **Returns:** their paths, sorted by name.
        """
        return sorted(self.path.glob("figures/*.png"))


def installed_version(name: str) -> str:
    """Version of an installed package.

    **Arguments:**

    - `name`: of the package.

    **Returns:** its version, or `"(not installed)"` for one that runs from its source folder.
    """
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"


def _numbered(path: Path) -> Path:
    """The first of path, path-2, path-3, … that is free, made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir()  # refuses an existing one: two runs at a time get two folders
            return folder
        except FileExistsError:
            if folder.is_dir() and not any(folder.iterdir()):
                return folder
        number += 1


def _clear(folder: Path) -> None:
    """Remove the files of an earlier run, and nothing else."""
    # Whoever points at the wrong folder must not lose it.
    if not (folder / CONFIG).is_file():
        raise RunFolderError(
            f"The folder {folder} is not empty and holds no run (no {CONFIG}), so it is not "
            "overwritten."
        )
    for pattern in _LEFTOVERS:
        for file in folder.glob(pattern):
            file.unlink()


def _changes(then: Any, now: Any, name: str = "") -> list[str]:
    """What differs between two configurations, in words."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        keys = dict.fromkeys([*then, *now])
        inside = lambda key: f"{name}.{key}" if name else key
        return [c for k in keys for c in _changes(then.get(k), now.get(k), inside(k))]
    return [] if then == now else [f"`{name}` was {then!r} and is {now!r}"]
