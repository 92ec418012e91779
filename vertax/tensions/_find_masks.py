"""Masks in folders, patterns, lists and movies."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Shaped

from vertax._base.checks import check_instance
from vertax.io import read_stack
from vertax.tensions._infer_tensions import infer_tensions, pixels_of_file
from vertax.tensions._inferred import InferredTensions
from vertax.tensions._mask import planes_of, read_mask, read_pixels

MaskSource: TypeAlias = Shaped[np.ndarray | Array, "..."] | str | os.PathLike[str]

_ENDINGS = (".tif", ".tiff", ".png", ".npy")


class MaskFrame(NamedTuple):
    """One of many masks."""

    name: str | int
    """Name of its file, or its number in a movie or list."""
    source: MaskSource
    """The file, or the pixels."""
    file: Path | None = None
    """The file that holds the pixels."""

    def mask(self, **options: Any) -> Shaped[np.ndarray, "rows columns"]:
        """The labels.

        **Arguments:**

        - `options`: as of [`read_mask`][vertax.tensions.read_mask].

        **Returns:** a label for each pixel.
        """
        return read_mask(self.source, **options)

    def infer(self, **options: Any) -> InferredTensions:
        """The tensions.

        **Arguments:**

        - `options`: as of [`infer_tensions`][vertax.tensions.infer_tensions].

        **Returns:** the [`InferredTensions`][vertax.tensions.InferredTensions].
        """
        if self.file is not None and options.get("pixel_size") is None:
            reading = {key: options[key] for key in ("kind", "background") if key in options}
            options = options | {"pixel_size": pixels_of_file(self.file, self.mask(**reading))}
        return infer_tensions(self.source, **options)


def find_masks(
    masks: MaskSource | Sequence[MaskSource | MaskFrame], *, plane: int | None = None
) -> list[MaskFrame]:
    """The masks in a folder, a pattern of file names, a movie, or a list.

    **Arguments:**

    - `masks`: a folder (its files .tif, .tiff, .png and .npy), a pattern such as `"masks/*.tif"` or, with
        subfolders, `"masks/**/*.tif"`, one file, an array of shape (rows, columns) or (frames, rows,
        columns), or a list of files, arrays and frames. A single file with several planes is a movie.
    - `plane`: of files with several planes, the one to take; then no file is a movie.

    **Returns:** the masks, files in natural order (2 before 10). Names are file names, with folders where
    these repeat, and numbers from 0 in a movie or in a list of arrays.

    **Raises:**

    - `FileNotFoundError` if there is no such file, or no file in the folder or of the pattern.
    - `TypeError` for another kind of argument.
    - `ValueError` for an empty list, and an array with fewer than two axes.
    """
    if isinstance(masks, str | os.PathLike):
        files = _files(os.fspath(masks))
        if len(files) == 1 and plane is None:
            return _frames_of(files[0])
        return _named(files)
    if isinstance(masks, np.ndarray | Array):
        planes = planes_of(np.asarray(masks))
        if planes.ndim < 3:
            raise ValueError(
                "Argument `masks` must have shape (rows, columns) or (frames, rows, columns), but its shape "
                f"is {masks.shape}."
            )
        return [MaskFrame(*frame) for frame in enumerate(planes)]
    check_instance(
        "masks", masks, Sequence, "a folder, a pattern, a file, an array or a list of these"
    )
    if not len(masks):
        raise ValueError("Argument `masks` must hold at least one mask, but is empty.")
    named = iter(_named([Path(m) for m in masks if isinstance(m, str | os.PathLike)]))
    is_file = [isinstance(mask, str | os.PathLike) for mask in masks]
    numbers = [str(k) if any(is_file) else k for k in range(len(masks))]
    return [
        mask if isinstance(mask, MaskFrame) else next(named) if file else MaskFrame(number, mask)
        for number, mask, file in zip(numbers, masks, is_file, strict=True)
    ]


def _files(path: str) -> list[Path]:
    """Files of a folder, of a pattern, or the file itself."""
    if os.path.isdir(path):
        files = [file for file in Path(path).iterdir() if file.suffix.lower() in _ENDINGS]
        what = f"files {', '.join(_ENDINGS)} in the folder {path}, but it has none"
        what += f" (with subfolders: {os.path.join(path, '**', '*.tif')})"
    elif os.path.exists(path) or not glob.has_magic(path):
        files = [Path(path)] if os.path.exists(path) else []
        what = f"a file, but {path} does not exist"
    else:
        files = [Path(file) for file in glob.glob(path, recursive=True) if os.path.isfile(file)]
        what = f"files by the pattern {path}, but there are none"
    if not files:
        raise FileNotFoundError(f"Argument `masks` must name {what}.")
    return sorted(files, key=_natural)


def _natural(file: Path) -> list[tuple[int, str]]:
    """A key that sorts 2 before 10."""
    parts = re.split(r"(\d+)", str(file))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _named(files: Sequence[Path]) -> list[MaskFrame]:
    names = [file.name for file in files]
    if len(set(names)) < len(names):
        names = [file.as_posix() for file in files]
    return [MaskFrame(name, file) for name, file in zip(names, files, strict=True)]


def _frames_of(file: Path) -> list[MaskFrame]:
    """The frames of one file: those of a movie, or the file itself."""
    single = [MaskFrame(file.name, file)]
    if file.suffix.lower() not in (".npy", ".tif", ".tiff") or file.name.endswith("_seg.npy"):
        return single
    try:
        frames = planes_of(read_pixels(file, "masks", read_stack))
    except ValueError:  # colours, or no image: the reader of masks has the message
        return single
    return single if len(frames) == 1 else [MaskFrame(*x, file) for x in enumerate(frames)]
