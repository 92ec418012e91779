"""Tensions of many masks: folders, lists and movies."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import warnings
from collections import UserDict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import vertax
from vertax._base.announce import announce_compilations
from vertax._base.atomic import atomic_write
from vertax._base.blas import one_blas_thread
from vertax._base.checkpoints import digest as arrays_digest
from vertax._base.checks import check_choice
from vertax._base.pixels import pixel_length, pixel_sides
from vertax._base.tasks import map_tasks
from vertax._base.threads import num_threads
from vertax.io import append_parquet, load, save, write_csv, write_rows
from vertax.tensions._columns import column_descriptions
from vertax.tensions._find_masks import MaskFrame, MaskSource, find_masks
from vertax.tensions._infer_tensions import infer_tensions
from vertax.tensions._inferred import InferredTensions

_TABLES = ("cells", "edges", "changes", "frames")
_MASKS_PER_PART = 64


class TensionsOfMasks(eqx.Module):
    """Tensions of many masks, as one table of cells and one of edges."""

    results: Mapping[str | int, InferredTensions]
    """The result of each mask, by the name of its file or its number. With a cache each is read from its file
    whenever it is used, so that memory does not limit their number."""
    failures: Mapping[str | int, str]
    """The message of the error of each mask without a result."""
    length_unit: str = eqx.field(static=True, default="root of the mean cell area")
    """Unit of lengths in the tables."""

    def cell_table(self) -> dict[str, np.ndarray]:
        """The cells of all masks as one table, see `cell_table` of
        [`InferredTensions`][vertax.tensions.InferredTensions].

        **Returns:** its columns, and `frame`, the name of the file or the number of the mask. A label has one
        number in all frames, as in the masks.
        """
        return _joined({name: result.cell_table() for name, result in self.results.items()})

    def edge_table(self) -> dict[str, np.ndarray]:
        """The edges of all masks as one table, see `edge_table` of
        [`InferredTensions`][vertax.tensions.InferredTensions].

        **Returns:** its columns, and `frame`.
        """
        return _joined({name: result.edge_table() for name, result in self.results.items()})

    def change_table(self) -> dict[str, np.ndarray]:
        """The changes of all masks as one table, see `change_table` of
        [`MaskReport`][vertax.initialise.MaskReport].

        **Returns:** its columns, and `frame`.
        """
        reports = {name: result.mask_report for name, result in self.results.items()}
        return _joined({name: r.change_table() for name, r in reports.items() if r is not None})

    def frame_table(self) -> dict[str, np.ndarray]:
        """The masks as a table: those with a result, then those without.

        **Returns:** columns `frame`, `n_cells`, `n_determined` (tensions), `noise_pixels`, `pixel_height`,
        `pixel_width` (in units of length), `warnings` and `error`.
        """
        rows = [_frame_row(result) for result in self.results.values()]
        failed = dict.fromkeys(rows[0], np.nan) | {"n_cells": 0, "n_determined": 0, "warnings": ""}
        rows += [failed | {"error": message} for message in self.failures.values()]
        frames = np.array([*self.results, *self.failures])
        return {"frame": frames} | {key: np.array([row[key] for row in rows]) for key in rows[0]}

    def write(
        self, folder: str | os.PathLike[str], *, format: Literal["csv", "parquet"] = "csv"
    ) -> list[Path]:
        """Write the tables `cells`, `edges`, `changes` (of the masks) and `frames`, 64 masks at a time, and
        `columns.csv`, which has the unit and the meaning of each column.

        **Arguments:**

        - `folder`: the folder; it is made if it does not exist. Tables in it are replaced.
        - `format`: `"csv"` for files `cells.csv` and so on; `"parquet"` for folders `cells` and so on, with a
            file for 64 masks that have rows: [`read_table`][vertax.io.read_table] reads each as one table.

        **Returns:** the files and folders.

        **Raises:**

        - `ValueError` for another format.
        - `ImportError` for Parquet files if PyArrow is not installed: `pip install -e ".[cluster]"`.
        """
        check_choice("format", format, ("csv", "parquet"))
        ending = ".csv" if format == "csv" else ""
        paths = {name: Path(folder) / f"{name}{ending}" for name in _TABLES}
        columns = Path(folder) / "columns.csv"
        columns.parent.mkdir(parents=True, exist_ok=True)
        for path in paths.values():
            for file in path.glob("*.parquet"):
                file.unlink()
        with contextlib.ExitStack() as stack:
            opened = lambda path: stack.enter_context(atomic_write(path, newline=""))
            files = {name: opened(path) for name, path in paths.items() if path.suffix == ".csv"}
            for number, part in enumerate(self._parts()):
                tables = {name: getattr(part, f"{name[:-1]}_table")() for name in _TABLES}
                if number == 0:
                    write_csv(columns, column_descriptions(tables, self.length_unit))
                for name, table in tables.items():
                    if name in files:
                        write_rows(files[name], table, names=number == 0)
                    elif len(table["frame"]):
                        append_parquet(paths[name], table)
        return [*paths.values(), columns]

    def _parts(self) -> Iterator[TensionsOfMasks]:
        """Parts of 64 masks, in memory; the failures are in the last one."""
        names = [*self.results]
        for begin in range(0, len(names), _MASKS_PER_PART):
            results = {name: self.results[name] for name in names[begin : begin + _MASKS_PER_PART]}
            failures = {} if begin + len(results) < len(names) else self.failures
            yield TensionsOfMasks(results, failures, self.length_unit)


class _Stored(UserDict[str | int, Any]):
    """Results in the files of a cache, each read when it is used."""

    def __getitem__(self, name: str | int) -> InferredTensions:
        result = self.data[name]
        return load(result, InferredTensions) if isinstance(result, Path) else result


@announce_compilations("measurements of a tissue")
@one_blas_thread()
def infer_tensions_of_masks(
    masks: MaskSource | Sequence[MaskSource | MaskFrame],
    *,
    plane: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    progress: bool = True,
    **options: Any,
) -> TensionsOfMasks:
    """Tensions of many masks, side by side.

    ```python
    movie = vx.tensions.infer_tensions_of_masks("masks/*.tif")
    movie.write("tensions")
    ```

    A mask that cannot be read or inferred does not stop the others: `failures` has its message.

    **Arguments:**

    - `masks`: a folder, a pattern, a movie or a list, see [`find_masks`][vertax.tensions.find_masks].
    - `plane`: of files with several planes, the one to take; by default a single file is a movie.
    - `cache`: a folder that stores the result of each mask as soon as it is computed: memory does not limit
        the number of masks. A later call finds there the results of the same pixels, options and version of
        vertax. A file that cannot be read is computed anew, with a warning.
    - `executor`: where masks are computed, as of [`map_tasks`][vertax.map_tasks]; by default threads, as many
        as the environment variable `VERTAX_THREADS` says or one per core. Workers on other machines need
        access to files that are given by name; the `cache` is used by the caller alone.
    - `progress`: show a progress bar (only on a terminal).
    - `options`: as of [`infer_tensions`][vertax.tensions.infer_tensions], the same for all masks.

    **Returns:** the [`TensionsOfMasks`][vertax.tensions.TensionsOfMasks].

    **Raises:**

    - `TypeError` for an unknown option.
    - `OSError` if the folder of the `cache` cannot be made.
    - the error of the mask, if there is only one.
    - `ValueError` if none of several masks has a result, and as
        [`find_masks`][vertax.tensions.find_masks].
    """
    inspect.signature(infer_tensions).bind(None, **options)
    frames = find_masks(masks, plane=plane)
    if cache is not None:
        Path(cache).mkdir(parents=True, exist_ok=True)
    if plane is not None:
        options["plane"] = plane
    results: dict[str | int, Any] = {}
    failures: dict[str | int, str] = {}
    missing: list[tuple[MaskFrame, Path | None]] = []
    for frame in frames:
        entry = None
        if cache is not None:
            with contextlib.suppress(OSError):  # of a mask, which its task raises
                entry = Path(cache) / _entry_name(frame, options)
        if entry is not None and _is_stored(entry, frame):
            results[frame.name] = entry
        else:
            missing.append((frame, entry))
    tasks = [frame for frame, _ in missing]
    with contextlib.ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(ThreadPoolExecutor(num_threads()))
        infer = partial(_infer, options=options)
        outcomes = map_tasks(infer, tasks, executor=executor, progress=progress, unit="mask")
        for number, result, error in stack.enter_context(contextlib.closing(outcomes)):
            frame, entry = missing[number]
            if error is not None:
                if len(frames) == 1:
                    raise error
                failures[frame.name] = str(error)
                continue
            if entry is not None:
                save(entry, result)
            results[frame.name] = result if entry is None else entry
    # In the order of the masks, not of the threads.
    order = [frame.name for frame in frames]
    results = {name: results[name] for name in order if name in results}
    failures = {name: failures[name] for name in order if name in failures}
    if not results:
        name, message = next(iter(failures.items()))
        raise ValueError(
            f"Argument `masks` must hold a mask that can be inferred, but all {len(failures)} failed; "
            f"{name}: {message}"
        )
    unit = {} if options.get("pixel_size") is None else {"length_unit": "unit of `pixel_size`"}
    return TensionsOfMasks(results if cache is None else _Stored(results), failures, **unit)


@one_blas_thread()
def _infer(frame: MaskFrame, *, options: Mapping[str, Any]) -> InferredTensions:
    return frame.infer(**options)


def _entry_name(frame: MaskFrame, options: Mapping[str, Any]) -> str:
    """The file in the cache: the pixels, the options, the precision and the version determine its name."""
    source = frame.source
    if isinstance(source, str | os.PathLike):
        pixels = Path(source).read_bytes()
    else:
        source = np.ascontiguousarray(source)
        pixels = source.tobytes() + f"{source.shape} {source.dtype}".encode()
    parts, height = dict(options), options.get("height")
    if isinstance(height, str | os.PathLike):
        parts["height"] = hashlib.sha256(Path(height).read_bytes()).hexdigest()
    elif height is not None:
        parts["height"] = arrays_digest(height)
    given = f"{sorted(parts.items())} {jnp.result_type(float)} {frame.file} {vertax.__version__}"
    return f"{hashlib.sha256(pixels + given.encode()).hexdigest()[:32]}.npz"


def _is_stored(entry: Path, frame: MaskFrame) -> bool:
    """Whether the result is in the cache and can be read."""
    try:
        return entry.exists() and load(entry, InferredTensions) is not None
    except ValueError as error:  # truncated or damaged
        text = f"The entry of the cache for {frame.name} is computed anew: {error}"
        warnings.warn(text, stacklevel=4)
        return False


def _joined(tables: Mapping[str | int, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One table of many with the same columns, with the column `frame` first."""
    lengths = [len(next(iter(table.values()))) for table in tables.values()]
    frame = np.repeat(np.array(list(tables)), lengths)
    first = next(iter(tables.values()), {})
    columns = {name: np.concatenate([table[name] for table in tables.values()]) for name in first}
    return {"frame": frame, **columns}


def _frame_row(result: InferredTensions) -> dict[str, Any]:
    width, height = pixel_sides(result.pixel_size)
    return {
        "n_cells": int(np.sum(result.labels > 0)),
        "n_determined": int(result.determined.sum()),
        "noise_pixels": result.noise / pixel_length(result.pixel_size),
        "pixel_height": height,
        "pixel_width": width,
        "warnings": " | ".join(result.warnings),
        "error": "",
    }
