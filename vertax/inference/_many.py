"""Tensions of many masks: folders, lists and movies."""

from __future__ import annotations

import concurrent.futures
import glob
import inspect
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Shaped
from tqdm import tqdm

from vertax._base.announce import announce_compilations
from vertax._base.blas import one_blas_thread
from vertax._base.checks import check_integer
from vertax._base.pixels import pixel_sides
from vertax.inference._columns import column_descriptions, length_unit
from vertax.inference._infer_tensions import infer_tensions, pixels_of_file
from vertax.inference._inferred import InferredTensions
from vertax.inference._mask import read_mask
from vertax.initialise._mask_arguments import without_single_axes
from vertax.io import read_stack, write_csv

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

        - `options`: as of [`read_mask`][vertax.inference.read_mask].

        **Returns:** a label for each pixel.
        """
        return read_mask(self.source, **options)

    def infer(self, **options: Any) -> InferredTensions:
        """The tensions.

        **Arguments:**

        - `options`: as of [`infer_tensions`][vertax.inference.infer_tensions].

        **Returns:** the [`InferredTensions`][vertax.inference.InferredTensions].
        """
        if self.file is not None and options.get("pixel_size") is None:
            reading = {key: options[key] for key in ("kind", "background") if key in options}
            options = options | {"pixel_size": pixels_of_file(self.file, self.mask(**reading))}
        return infer_tensions(self.source, **options)


def find_masks(
    masks: MaskSource | Sequence[MaskSource], *, plane: int | None = None
) -> list[MaskFrame]:
    """The masks in a folder, a pattern of file names, a movie, or a list.

    **Arguments:**

    - `masks`: a folder (its files .tif, .tiff, .png and .npy), a pattern such as `"masks/*.tif"`, one file,
        an array of shape (rows, columns) or (frames, rows, columns), or a list of files and arrays. A single
        file with several planes is a movie.
    - `plane`: of files with several planes, the one to take; then no file is a movie.

    **Returns:** the masks, files in natural order (2 before 10). Names are file names, with folders where
    these repeat, and numbers from 0 in a movie or in a list of arrays.

    **Raises:**

    - `FileNotFoundError` if there is no such file, or no file in the folder or of the pattern.
    - `ValueError` for an empty list, and an array with fewer than two axes.
    """
    if isinstance(masks, str | os.PathLike):
        files = _files(os.fspath(masks))
        if len(files) == 1 and plane is None:
            return _frames_of(files[0])
        return _named(files)
    if isinstance(masks, np.ndarray | Array):
        pixels = without_single_axes(np.asarray(masks))
        if pixels.ndim < 2:
            raise ValueError(
                "Argument `masks` must have shape (rows, columns) or (frames, rows, columns), but its shape "
                f"is {pixels.shape}."
            )
        return _planes(pixels)
    if not len(masks):
        raise ValueError("Argument `masks` must hold at least one mask, but is empty.")
    named = iter(_named([Path(m) for m in masks if isinstance(m, str | os.PathLike)]))
    is_file = [isinstance(mask, str | os.PathLike) for mask in masks]
    return [
        next(named) if file else MaskFrame(number if not any(is_file) else str(number), mask)
        for number, (mask, file) in enumerate(zip(masks, is_file, strict=True))
    ]


class TensionsOfMasks(eqx.Module):
    """Tensions of many masks, as one table of cells and one of edges."""

    results: dict[str | int, InferredTensions]
    """The result of each mask, by the name of its file or its number."""
    failures: dict[str | int, str]
    """The message of the error of each mask without a result."""
    length_unit: str = eqx.field(static=True)
    """Unit of lengths in the tables."""

    def cell_table(self) -> dict[str, np.ndarray]:
        """The cells of all masks as one table, see `cell_table` of
        [`InferredTensions`][vertax.inference.InferredTensions].

        **Returns:** its columns, and `frame`, the name of the file or the number of the mask. A label has one
        number in all frames, as in the masks.
        """
        return join_frames({name: result.cell_table() for name, result in self.results.items()})

    def edge_table(self) -> dict[str, np.ndarray]:
        """The edges of all masks as one table, see `edge_table` of
        [`InferredTensions`][vertax.inference.InferredTensions].

        **Returns:** its columns, and `frame`.
        """
        return join_frames({name: result.edge_table() for name, result in self.results.items()})

    def frame_table(self) -> dict[str, np.ndarray]:
        """The masks as a table.

        **Returns:** columns `frame`, `n_cells`, `n_determined` (tensions), `noise_pixels`, `pixel_height`,
        `pixel_width` (in units of length), `warnings` and `error`.
        """
        names = [*self.results, *self.failures]
        return frame_table(names, [frame_summary(r) for r in self.results.values()], self.failures)

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write the tables `cells.csv`, `edges.csv` and `frames.csv`, and `columns.csv`, which has the unit
        and the meaning of each column.

        **Arguments:**

        - `folder`: the folder; it is made if it does not exist.

        **Returns:** the files.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        tables = {
            "cells": self.cell_table(),
            "edges": self.edge_table(),
            "frames": self.frame_table(),
        }
        tables["columns"] = column_descriptions(tables, self.length_unit)
        for name, table in tables.items():
            write_csv(folder / f"{name}.csv", table)
        return [folder / f"{name}.csv" for name in tables]


@announce_compilations("measurements of a tissue")
@one_blas_thread()
def infer_tensions_of_masks(
    masks: MaskSource | Sequence[MaskSource],
    *,
    plane: int | None = None,
    threads: int | None = None,
    progress: bool = True,
    **options: Any,
) -> TensionsOfMasks:
    """Tensions of many masks, side by side in threads.

    ```python
    movie = vx.inference.infer_tensions_of_masks("masks/*.tif")
    movie.write("tensions")
    ```

    A mask that cannot be read or inferred does not stop the others: `failures` has its message.

    **Arguments:**

    - `masks`: a folder, a pattern, a movie or a list, see [`find_masks`][vertax.inference.find_masks].
    - `plane`: of files with several planes, the one to take; by default a single file is a movie.
    - `threads`: number of threads, by default one per core.
    - `progress`: show a progress bar with the name of the last mask (only on a terminal).
    - `options`: as of [`infer_tensions`][vertax.inference.infer_tensions], the same for all masks.

    **Returns:** the [`TensionsOfMasks`][vertax.inference.TensionsOfMasks].

    **Raises:**

    - `TypeError` for an unknown option.
    - `ValueError` if no mask has a result, and as [`find_masks`][vertax.inference.find_masks].
    """
    inspect.signature(infer_tensions).bind(None, **options)
    if threads is not None:
        check_integer("threads", threads, at_least=1)
    frames = find_masks(masks, plane=plane)
    if plane is not None:
        options["plane"] = plane
    results: dict[str | int, InferredTensions] = {}
    failures: dict[str | int, str] = {}
    with (
        concurrent.futures.ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool,
        tqdm(total=len(frames), unit="mask", disable=None if progress else True) as bar,
    ):
        waiting = {pool.submit(frame.infer, **options): frame.name for frame in frames}
        try:
            for done in concurrent.futures.as_completed(waiting):
                name = waiting[done]
                bar.set_postfix_str(str(name))
                try:
                    results[name] = done.result()
                except Exception as error:
                    failures[name] = str(error)
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    check_any(results, failures)
    order = [frame.name for frame in frames]
    return TensionsOfMasks(
        {name: results[name] for name in order if name in results},
        {name: failures[name] for name in order if name in failures},
        length_unit(options.get("pixel_size")),
    )


def check_any(results: Mapping[str | int, Any], failures: Mapping[str | int, str]) -> None:
    """Raise a `ValueError` if there are no results."""
    if not results:
        name, message = next(iter(failures.items()))
        raise ValueError(
            f"Argument `masks` must hold a mask that can be inferred, but all {len(failures)} failed; "
            f"{name}: {message}"
        )


def join_frames(tables: Mapping[str | int, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One table of many, with the column `frame` first.

    **Arguments:**

    - `tables`: a table for each frame, all with the same columns.

    **Returns:** the columns by name.
    """
    first = next(iter(tables.values()))
    lengths = [len(next(iter(table.values()))) for table in tables.values()]
    frame = np.repeat(np.array(list(tables)), lengths)
    columns = {name: np.concatenate([table[name] for table in tables.values()]) for name in first}
    return {"frame": frame, **columns}


def frame_summary(result: InferredTensions) -> dict[str, Any]:
    """Numbers and warnings of one mask, a row of the table of frames."""
    width, height = pixel_sides(result.pixel_size)
    return {
        "n_cells": int(np.sum(result.labels > 0)),
        "n_determined": int(result.determined.sum()),
        "noise_pixels": result.noise / np.sqrt(width * height),
        "pixel_height": height,
        "pixel_width": width,
        "warnings": " | ".join(result.warnings),
    }


def frame_table(
    names: Sequence[str | int],
    summaries: Sequence[Mapping[str, Any]],
    failures: Mapping[str | int, str],
) -> dict[str, np.ndarray]:
    """The table of frames: those with a result first, then the others, with the message of the error."""
    missing = {"warnings": "", "n_cells": 0, "n_determined": 0}
    rows = [*summaries, *[{} for _ in failures]]
    columns = {
        key: np.array([row.get(key, missing.get(key, np.nan)) for row in rows])
        for key in summaries[0]
    }
    errors = [""] * len(summaries) + list(failures.values())
    return {"frame": np.array(names), **columns, "error": np.array(errors)}


def _files(path: str) -> list[Path]:
    """Files of a folder, of a pattern, or the file itself."""
    if os.path.isdir(path):
        files = [file for file in Path(path).iterdir() if file.suffix.lower() in _ENDINGS]
        what = f"files {', '.join(_ENDINGS)} in the folder {path}, but it has none"
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
        pixels = np.load(file) if file.suffix == ".npy" else read_stack(file)
    except (
        ValueError
    ):  # colours, or a file that cannot be read: the reader of masks has the message
        return single
    frames = _planes(without_single_axes(pixels))
    return single if len(frames) == 1 else [frame._replace(file=file) for frame in frames]


def _planes(pixels: Shaped[np.ndarray, "..."]) -> list[MaskFrame]:
    """The frames of an array; a last axis of 3 or 4 is one of colours."""
    if pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4)):
        return [MaskFrame(0, pixels)]
    return [MaskFrame(k, p) for k, p in enumerate(pixels.reshape(-1, *pixels.shape[-2:]))]
