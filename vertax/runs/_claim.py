"""Find or make the folder of a new or resumed run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vertax.runs._config import ExperimentConfig, read_toml, validate
from vertax.runs._errors import RunFolderError
from vertax.runs._figures import FIGURE_FORMATS

CONFIG, METRICS, PARTS = "config.toml", "metrics.json", "unfinished"
# The error message of a run that failed and cannot be resumed: its folder may be used again.
FAILED = "failed.txt"
FIGURES = tuple(f"figures/*.{ending}" for ending in FIGURE_FORMATS)
# Files of a run. METRICS is removed first, so that a folder that has it is complete.
_LEFTOVERS = (METRICS, FAILED, "*.csv", "*.geojson", "*.npz", "*.npy", *FIGURES, f"{PARTS}/*.npz")


def claimed(default: Path, output: str | os.PathLike[str] | None, overwrite: bool) -> Path:
    """A folder without results, see `RunFolder.claim`.

    **Raises:**

    - `RunFolderError` if the folder that was asked for cannot be used.
    """
    folder = default if output is None else Path(output)
    try:
        if output is None and not overwrite:
            return _numbered(default)
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            if not overwrite and not (folder / FAILED).is_file():
                raise RunFolderError(
                    f"The folder {folder} is not empty. Choose another with --output, or pass "
                    "--overwrite to replace the run in it."
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


def existing(path: str | os.PathLike[str]) -> Path:
    """The folder of an earlier run, see `RunFolder.existing`.

    **Raises:**

    - `RunFolderError` if it is none.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "it is a file" if folder.exists() else "there is none"
        raise RunFolderError(f"{folder} is not the folder of a run: {what}.")
    if not (folder / CONFIG).is_file():
        raise RunFolderError(
            f"{folder} is not the folder of a run: there is no {CONFIG} in it, which a run writes first."
        )
    return folder


def unfinished(path: str | os.PathLike[str], config: ExperimentConfig) -> Path:
    """The folder of a run that can be resumed, see `RunFolder.unfinished`.

    **Raises:**

    - `RunFolderError` if it cannot.
    """
    folder = existing(path)
    if (folder / METRICS).exists():
        raise RunFolderError(
            f"The run in {folder} is finished: there is nothing to resume. To see what it found: "
            f"vertax show {folder}"
        )
    earlier = read_toml(folder / CONFIG)
    if earlier.get("experiment") != (config.model_dump().get("experiment")):
        raise RunFolderError(
            f"The run in {folder} is one of the experiment {earlier.get('experiment')!r}. Give its "
            f"own configuration: vertax run {folder / CONFIG} --resume {folder}"
        )
    if changed := changes(folder, config):
        raise RunFolderError(
            f"The run in {folder} has another configuration: {'; '.join(changed)}. Give its own, "
            f"vertax run {folder / CONFIG} --resume {folder}, or begin a new run without --resume."
        )
    return folder


def changes(folder: Path, config: ExperimentConfig) -> list[str]:
    """Differences between the configuration of the run in a folder and another one, in words."""
    then = validate(type(config), read_toml(folder / CONFIG), str(folder / CONFIG))
    return _changes(then.model_dump(mode="json"), config.model_dump(mode="json"))


def _numbered(path: Path) -> Path:
    """Make the first folder of path, path-2, path-3, … that does not exist."""
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
    # A wrong folder must not be cleared.
    if not (folder / CONFIG).is_file():
        raise RunFolderError(
            f"The folder {folder} is not empty and holds no run (no {CONFIG}), so it is not "
            "overwritten."
        )
    for pattern in _LEFTOVERS:
        for file in folder.glob(pattern):
            file.unlink()


def _changes(then: Any, now: Any, name: str = "") -> list[str]:
    """Differences between two configurations, in words."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        keys = dict.fromkeys([*then, *now])
        inside = lambda key: f"{name}.{key}" if name else key
        return [c for k in keys for c in _changes(then.get(k), now.get(k), inside(k))]
    return [] if then == now else [f"`{name}` was {then!r} and is {now!r}"]
