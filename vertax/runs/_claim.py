"""The folder of a new run, found or made without touching an earlier one."""

from __future__ import annotations

import os
from pathlib import Path

from vertax.runs._errors import RunFolderError
from vertax.runs._figures import FIGURE_FORMATS

CONFIG, METRICS, PARTS = "config.toml", "metrics.json", "unfinished"
FIGURES = tuple(f"figures/*.{ending}" for ending in FIGURE_FORMATS)
# What a run may have left behind; METRICS goes first, so that a folder which holds it is complete.
_LEFTOVERS = (METRICS, "*.csv", "*.npz", "*.npy", *FIGURES, f"{PARTS}/*.npz")


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
    except OSError as error:
        raise RunFolderError(
            f"Cannot use {folder} as a folder: {error.strerror}. Choose another with --output."
        ) from None
    return folder


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
