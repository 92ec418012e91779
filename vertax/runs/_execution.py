"""Begin, resume, execute and finish runs: the states of a folder.

A folder with `metrics.json` holds a finished run, one with `failed.txt` a run that can only be repeated, and
any other folder with `config.toml` a run that can be resumed.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import vertax
from vertax._base.atomic import atomic_write
from vertax._base.extras import requires_extra
from vertax.runs._config import ExperimentConfig, differences, read_toml, validate
from vertax.runs._folder import METRICS, PARTS, RunFolder, RunFolderError
from vertax.runs._registry import Experiment

with requires_extra("run", "A run"):
    import matplotlib
    import tomli_w

CONFIG, FAILED = "config.toml", "failed.txt"
_FIGURES = tuple(f"figures/*.{ending}" for ending in ("png", "pdf", "svg"))
# Files of a run. METRICS is removed first: a folder that has it is complete. CONFIG, which marks the folder
# of a run, is removed last.
_FILES = (
    METRICS,
    FAILED,
    "*.csv",
    "*.gif",
    "*.geojson",
    "*.npz",
    "*.npy",
    "*/*.parquet",
    *_FIGURES,
    f"{PARTS}/*.npz",
    CONFIG,
)


def new_folder(
    default: Path, output: str | os.PathLike[str] | None = None, overwrite: bool = False
) -> Path:
    """Make the folder of a new run: `default`, or `default-2`, … if that exists; or exactly `output`.

    An earlier run in `output` is removed if it failed, or with `overwrite`. A `RunFolderError` says why the
    folder cannot be used.
    """
    folder = default if output is None else Path(output)
    try:
        if output is None and not overwrite:
            return _numbered(default)
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            if not overwrite and not (folder / FAILED).is_file():
                unfinished = parts(folder) and not (folder / METRICS).exists()
                remedy = f", --resume {folder} to continue it" if unfinished else ""
                raise RunFolderError(
                    f"The folder {folder} is not empty. Choose another with --output, or pass "
                    f"--overwrite to replace the run in it{remedy}."
                )
            _clear(folder)
    except (FileExistsError, NotADirectoryError) as error:
        raise RunFolderError(
            f"Cannot use {error.filename} as a folder: there is a file of that name."
        ) from None
    except OSError as error:
        raise RunFolderError(
            f"Cannot use {folder} as a folder: {error.strerror}. Choose another with --output."
        ) from None
    return folder


def existing_folder(path: str | os.PathLike[str]) -> Path:
    """The folder of an earlier run; a `RunFolderError` for another folder."""
    folder = Path(path)
    if not folder.is_dir():
        state = "it is a file" if folder.exists() else "it does not exist"
        raise RunFolderError(f"{folder} is not the folder of a run: {state}.")
    if not (folder / CONFIG).is_file():
        raise RunFolderError(
            f"{folder} is not the folder of a run: it has no {CONFIG}, which a run writes first."
        )
    return folder


def unfinished_folder(path: str | os.PathLike[str], config: ExperimentConfig) -> Path:
    """The folder of a run of this configuration that can be resumed; a `RunFolderError` for another one."""
    folder = existing_folder(path)
    if (folder / METRICS).exists():
        raise RunFolderError(
            f"The run in {folder} is finished: there is nothing to resume. To print its results: "
            f"vertax show {folder}"
        )
    name, repeat = config.experiment, f"vertax run {folder / CONFIG} --resume {folder}"
    if (earlier := read_toml(folder / CONFIG).get("experiment")) != name:
        raise RunFolderError(
            f"The run in {folder} is of the experiment {earlier!r} and not {name!r}. Give its own "
            f"configuration: {repeat}"
        )
    if changed := changes(folder, config):
        raise RunFolderError(
            f"The run in {folder} has another configuration: {'; '.join(changed)}. Give its own, {repeat}, "
            "or begin a new run without --resume."
        )
    return folder


def changes(folder: Path, config: ExperimentConfig) -> list[str]:
    """Differences between the configuration of the run in a folder and another one, in sentences."""
    then = validate(type(config), read_toml(folder / CONFIG), str(folder / CONFIG))
    return differences(then.model_dump(mode="json"), config.model_dump(mode="json"))


def write_config(folder: Path, config: ExperimentConfig) -> None:
    """Write the configuration with all defaults; `vertax run` on the written file repeats the run."""
    # TOML has no null: a key that is None by default is left out.
    content = config.model_dump(mode="json", exclude_none=True)
    programs = {each.__name__: each.__version__ for each in (vertax, jax, np)}
    versions = [*programs.items(), ("Python", platform.python_version())]
    with atomic_write(folder / CONFIG) as file:
        file.write(f"# Run by {', '.join(map(' '.join, versions))}.\n")
        file.write(tomli_w.dumps(content))


def execute(
    experiment: Experiment, config: ExperimentConfig, folder: RunFolder, *, progress: bool
) -> Mapping[str, Any]:
    """Execute or resume a run: write its results, then its metrics, and remove its checkpoints.

    A run that fails leaves no folder if it wrote nothing, and otherwise `failed.txt`, so that the same
    command can be repeated; a run that has checkpoints can be resumed.
    """
    # The configuration sets the precision; the library does not. Figures are written to files only.
    jax.config.update("jax_enable_x64", config.precision == "float64")
    matplotlib.use("Agg")
    resumed = (folder.path / CONFIG).is_file()
    if not resumed:
        write_config(folder.path, config)
    try:
        metrics = experiment.run(config, folder, progress=progress)
    except Exception as error:
        if not resumed:
            _end_failed(folder.path, error)
        raise
    if folder.interrupted:
        raise KeyboardInterrupt
    folder.save_metrics(metrics)
    for part in parts(folder.path):
        part.unlink()
    with contextlib.suppress(OSError):  # missing, or with other files
        (folder.path / PARTS).rmdir()
    return metrics


def read_metrics(folder: Path) -> dict[str, Any]:
    """The metrics of a finished run; a `RunFolderError` if they cannot be read."""
    file = folder / METRICS
    try:
        metrics = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunFolderError(f"{file} is not valid JSON ({error}).") from None
    if not isinstance(metrics, dict):
        raise RunFolderError(f"{file} must hold metrics by name, but holds {metrics!r:.80}.")
    return metrics


def parts(folder: Path) -> list[Path]:
    """The files of fits and other parts that a resumed run keeps."""
    return sorted(folder.glob(f"{PARTS}/*.npz"))


def _end_failed(folder: Path, error: Exception) -> None:
    files = [file for file in folder.rglob("*") if file.is_file()]
    if files == [folder / CONFIG]:
        files[0].unlink()
        with contextlib.suppress(OSError):  # in use, or missing
            for each in (folder / PARTS, folder / "figures", folder):
                if each.is_dir():
                    each.rmdir()
    elif not parts(folder):
        (folder / FAILED).write_text(f"{error}\n", encoding="utf-8")


def _numbered(path: Path) -> Path:
    """Make the first folder of path, path-2, path-3, … that does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir()  # raises for an existing one: two processes get two folders
            return folder
        except FileExistsError:
            if folder.is_dir() and not any(folder.iterdir()):
                return folder
        number += 1


def _clear(folder: Path) -> None:
    """Remove the files of an earlier run, and nothing else."""
    if not (folder / CONFIG).is_file():
        raise RunFolderError(
            f"The folder {folder} is not empty and holds no run (no {CONFIG}), so it is not overwritten."
        )
    for pattern in _FILES:
        for file in folder.glob(pattern):
            file.unlink()
