"""Run folders: where an experiment leaves its results."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tomli_w
from jaxtyping import Shaped
from matplotlib.figure import Figure

from vertax._fit import Fit, History
from vertax._tissue import Tissue
from vertax.experiments._config import ExperimentConfig
from vertax.io import atomic_write, save_tissue

CONFIG, METRICS = "config.toml", "metrics.json"
# What a run may have left behind; METRICS goes first, so that a folder which holds it is complete.
_LEFTOVERS = (METRICS, "*.csv", "*.npz", "*.npy", "figures/*.png")


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

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)

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
            json.dump(_plain(metrics), file, indent=2, allow_nan=False)
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
                f"still going or it failed; to repeat it: vertax run {self.path / CONFIG}"
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


def history_columns(history: History, **labels: str) -> dict[str, Any]:
    """The columns of a table of the epochs of a fit.

    **Arguments:**

    - `history`: a [`History`][vertax.History].
    - `labels`: columns of one repeated text each, to tell fits apart in one table.

    **Returns:** the labels, the number of the epoch and every known curve of the history.
    """
    n = len(history.cost)
    return {name: [text] * n for name, text in labels.items()} | {
        "epoch": np.arange(n),
        **history.columns(),
    }


def histories(outcome: Fit, labels: Sequence[dict[str, str]]) -> dict[str, Any]:
    """The table of all epochs of a batch.

    **Arguments:**

    - `outcome`: the fit of the batch.
    - `labels`: of each member, what tells it apart.

    **Returns:** columns by name.
    """
    single = lambda k: jax.tree.map(lambda x: x[:, k] if x.ndim > 1 else x, outcome.history)
    parts = [history_columns(single(k), **label) for k, label in enumerate(labels)]
    names = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def joined(tables: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Tables one below the other, with the columns that all of them have.

    **Arguments:**

    - `tables`: columns by name.

    **Returns:** columns by name.
    """
    names = [name for name in tables[0] if all(name in table for table in tables)]
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


def fit_metrics(outcome: Fit) -> dict[str, Any]:
    """What every fit has to tell.

    **Arguments:**

    - `outcome`: the fit.

    **Returns:** costs, largest force, epochs, seconds and T1 transitions.
    """
    history = outcome.history
    return {
        "cost_initial": history.cost[0],
        "cost_final": outcome.cost,
        "max_force": outcome.max_force,
        "epochs": len(history.cost),
        "best_epoch": outcome.best_epoch,
        # The first epoch is the one that is compiled.
        "seconds_per_epoch": np.median(history.seconds[1:]) if len(history.cost) > 1 else np.nan,
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
    }


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


def summary(metrics: Mapping[str, Any]) -> str:
    """Metrics as text tables, one column for each group of them.

    **Arguments:**

    - `metrics`: numbers by name, or mappings of numbers by the name of the group; if there are
        groups, other entries are left out.

    **Returns:** the tables: groups that have names in common share one.
    """
    plain: dict[str, Any] = _plain(metrics)
    groups = {"": plain} | {k: group for k, group in plain.items() if isinstance(group, dict)}
    groups = {k: group for k, group in groups.items() if any(map(_is_number, group.values()))}
    if len(groups) > 1:
        groups.pop("", None)
    return "\n\n".join(_table(alike) for alike in _alike(groups))


def _alike(groups: Mapping[str, dict[str, Any]]) -> list[dict[str, dict[str, Any]]]:
    """Groups that have names in common, which make one table each."""
    tables: list[dict[str, dict[str, Any]]] = []
    for label, group in groups.items():
        own = {label: {name: value for name, value in group.items() if _is_number(value)}}
        for table in tables:
            if any(own[label].keys() & other.keys() for other in table.values()):
                table |= own
                break
        else:
            tables.append(own)
    return tables


def _table(groups: Mapping[str, dict[str, Any]]) -> str:
    names = dict.fromkeys(name for group in groups.values() for name in group)
    rows = [["", *groups]] if any(groups) else []
    rows += [[name, *(_short(group.get(name)) for group in groups.values())] for name in names]
    first, *others = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join([name.ljust(first), *map(str.rjust, entries, others)]) for name, *entries in rows
    ]
    return "\n".join(lines)


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


def _plain(value: Any) -> Any:
    """A value that strict JSON can hold."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and scalars of NumPy and JAX
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    return f"{value:.4g}" if _is_number(value) else ""
