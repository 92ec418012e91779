"""Cells and edges as tables, for pandas, R and spreadsheets."""

from __future__ import annotations

import csv
import datetime
import math
import numbers
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped

from vertax._base.atomic import atomic_write
from vertax._base.checks import check_concrete, check_instance, describe
from vertax._base.extras import requires_extra
from vertax._base.model_checks import check_single
from vertax.mesh import Drawing, Tissue, pad

Column: TypeAlias = Array | np.ndarray | Sequence[Any]


def cell_table(tissue: Tissue, **columns: Column) -> dict[str, Shaped[np.ndarray, " cells"]]:
    """The cells of a tissue as a table with one row for each cell.

    ```python
    table = vx.io.cell_table(fit.tissue, p0=fit.energy.target_shape_factor)
    frame = pandas.DataFrame(table)
    ```

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `columns`: more columns by name, one entry for each cell.

    **Returns:** NumPy arrays by the name of the column: `cell`, the number, from 0; `x` and `y`, the
    centroid, in the home box of a periodic tissue; `area`, `perimeter` and `shape_factor`; `sides`, the
    number of edges; `on_outline`, whether the cell borders on the exterior; and those of `columns`. Spare
    slots have no rows. On a surface `x` and `y` are coordinates in the chart; sizes are those in space.

    **Raises:**

    - `ValueError` for a batch of tissues, and for a column of another length or with the name of
        another column.
    - `TypeError` if `tissue` is not a tissue, and inside `jax.jit` or `jax.vmap`.
    """
    check_writable(tissue)
    return cell_columns(tissue, Drawing(tissue), columns)


def edge_table(tissue: Tissue, **columns: Column) -> dict[str, Shaped[np.ndarray, " edges"]]:
    """The edges of a tissue as a table with one row for each edge.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `columns`: more columns by name, one entry for each edge.

    **Returns:** NumPy arrays by the name of the column: `edge`, the number, from 0; `left_cell` and
    `right_cell`, where -1 is the exterior; `start_vertex` and `end_vertex`; `start_x`, `start_y`,
    `end_x` and `end_y`, in the periodic image of the cell on the left; `length`; `angle`, between chord
    and tangents, 0 for a straight edge; `on_outline`; and those of `columns`.

    **Raises:** as [`cell_table`][vertax.io.cell_table].
    """
    check_writable(tissue)
    return edge_columns(tissue, Drawing(tissue), columns)


def write_csv(path: str | os.PathLike[str], table: Mapping[str, Column]) -> None:
    """Write a table to a CSV file.

    ```python
    vx.io.write_csv("cells.csv", vx.io.cell_table(tissue))
    ```

    Numbers are written with all digits: reading them gives the same bits. Missing values (NaN, NaT, None and
    masked entries) are empty fields, which pandas and R read as missing; an infinite number is `Inf` or
    `-Inf`, a boolean `True` or `False`. The file is written atomically. [`read_table`][vertax.io.read_table]
    reads it.

    **Arguments:**

    - `path`: the file.
    - `table`: columns by name, all of one length: numbers, booleans or text.

    **Raises:**

    - `ValueError` for columns of different lengths, or of more than one dimension.
    - `TypeError` if `table` is not a table, or holds other things than numbers, booleans, text and dates.
    """
    with atomic_write(path, newline="") as file:
        write_rows(file, table)


def write_rows(file: IO[str], table: Mapping[str, Column], *, names: bool = True) -> None:
    """Write a part of a table to an open CSV file.

    **Arguments:**

    - `file`: the file, open for text with `newline=""`.
    - `table`: as of [`write_csv`][vertax.io.write_csv].
    - `names`: write the names of the columns first.

    **Raises:** as [`write_csv`][vertax.io.write_csv].
    """
    columns = _columns(table)
    texts = [[_text(name, value) for value in column] for name, column in columns.items()]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerows([columns] if names else [])
    writer.writerows(zip(*texts, strict=True))


def append_parquet(folder: str | os.PathLike[str], table: Mapping[str, Column]) -> Path:
    """Append rows to a table in a folder of Parquet files: each call writes one file, atomically.

    [`read_table`][vertax.io.read_table], pandas, Polars and Dask read the folder as one table.

    ```python
    finished = set(vx.io.read_table("results")["task"])  # of an earlier run: continue with the others
    ```

    **Arguments:**

    - `folder`: the folder; it is made if it does not exist.
    - `table`: as of [`write_csv`][vertax.io.write_csv]; some thousand rows at a time make few files.

    **Returns:** the file. Files are numbered.

    **Raises:** as [`write_csv`][vertax.io.write_csv], and

    - `ImportError` if PyArrow is not installed: `pip install -e ".[cluster]"`.
    """
    with requires_extra("cluster", "Writing Parquet files"):
        import pyarrow  # pyright: ignore[reportMissingImports]
        import pyarrow.parquet  # pyright: ignore[reportMissingImports]
    masked = {
        name: (np.ma.getdata(x), np.ma.getmaskarray(x)) for name, x in _columns(table).items()
    }
    arrays = {name: pyarrow.array(data, mask=mask) for name, (data, mask) in masked.items()}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((int(file.stem) for file in folder.glob("*.parquet")), default=-1)
    with atomic_write(folder / f"{number:06}.parquet", "wb") as file:
        pyarrow.parquet.write_table(pyarrow.table(arrays), file)
    return folder / f"{number:06}.parquet"


def _columns(table: Mapping[str, Column]) -> dict[str, np.ndarray]:
    """The columns of a table as arrays of one dimension and one length."""
    if not isinstance(table, Mapping):
        raise TypeError(
            f"Argument `table` must hold columns by name, as a dictionary does, but is {describe(table)}."
        )
    columns = {name: _as_column(name, column) for name, column in table.items()}
    for name, column in columns.items():
        if column.ndim != 1:
            raise ValueError(
                f"Argument `table` must hold columns of one dimension, but `{name}` has shape "
                f"{column.shape}."
            )
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"Argument `table` must hold columns of one length, but they have {lengths}."
        )
    return columns


def cell_columns(
    tissue: Tissue, drawing: Drawing, columns: Mapping[str, Column]
) -> dict[str, np.ndarray]:
    """The columns of `cell_table`, cells placed as in a drawing."""
    n, padded = tissue.n_cells, pad(tissue)  # tissues of similar size share compiled functions
    outline = np.asarray(padded.topology.edge_cells)[np.asarray(padded.topology.on_outline)]
    table = {
        "cell": np.arange(n),
        "x": drawing.centroids[:, 0],
        "y": drawing.centroids[:, 1],
        "area": padded.areas,
        "perimeter": padded.perimeters,
        "shape_factor": padded.shape_factors,
        "sides": padded.neighbour_counts,
        "on_outline": np.isin(np.arange(n), outline),
    }
    table = _joined(table, columns, "cell", tissue.n_cells)
    return {name: column[drawing.alive] for name, column in table.items()}


def edge_columns(
    tissue: Tissue, drawing: Drawing, columns: Mapping[str, Column]
) -> dict[str, np.ndarray]:
    """The columns of `edge_table`, edges placed as in a drawing."""
    n, padded = tissue.n_edges, pad(tissue)
    m = padded.topology
    cells, vertices = np.asarray(m.edge_cells)[:n], np.asarray(m.edge_vertices)[:n]
    cells = np.where(cells == padded.n_cells, -1, cells)
    # The end of an edge is the start of the next half-edge of the cell, exactly; the end of the line that
    # draws an arc is rounded.
    start = drawing.lines[drawing.half_edge, 0]
    end = drawing.lines[drawing.following[drawing.half_edge], 0]
    table = {
        "edge": np.arange(n),
        "left_cell": cells[:, 0],
        "right_cell": cells[:, 1],
        "start_vertex": vertices[:, 0],
        "end_vertex": vertices[:, 1],
        "start_x": start[:, 0],
        "start_y": start[:, 1],
        "end_x": end[:, 0],
        "end_y": end[:, 1],
        "length": padded.edge_lengths,
        "angle": padded.edge_angles,
        "on_outline": m.on_outline,
    }
    table = _joined(table, columns, "edge", tissue.n_edges)
    return {name: column[drawing.alive_edges] for name, column in table.items()}


def check_writable(tissue: Tissue) -> None:
    """Raise an error unless `tissue` is one concrete tissue."""
    check_instance("tissue", tissue, Tissue, "a vertax.Tissue")
    check_single(tissue, "Write its members, e.g. vertax.fitting.member(tissue, 0), one by one.")
    check_concrete("A function that writes a tissue", tissue)


def _joined(
    table: Mapping[str, Any], columns: Mapping[str, Column], what: str, size: int
) -> dict[str, np.ndarray]:
    joined = {name: np.asarray(column)[:size] for name, column in table.items()}
    if not isinstance(columns, Mapping):
        raise TypeError(
            f"Columns of the {what}s must be given by name, as in a dictionary, but are {describe(columns)}."
        )
    for name, column in columns.items():
        if name in joined:
            raise ValueError(
                f"There is a column `{name}` already; the columns of the table are: {', '.join(table)}. "
                "Choose another name."
            )
        joined[name] = _as_column(name, column)
        if joined[name].shape != (size,):
            raise ValueError(
                f"Column `{name}` must have one entry for each {what}, shape ({size},), but has shape "
                f"{joined[name].shape}."
            )
    return joined


def _as_column(name: str, column: Column) -> np.ndarray:
    check_concrete(f"Column `{name}`", column)
    try:
        array = np.ma.asarray(column) if np.ma.isMaskedArray(column) else np.asarray(column)
    except ValueError as error:
        raise ValueError(
            f"Column `{name}` must hold one entry a row, but its entries have different lengths."
        ) from error
    # Other programs cannot read bfloat16 and similar types.
    foreign = array.dtype.kind == "V" and jnp.issubdtype(array.dtype, jnp.floating)
    return array.astype(np.float32) if foreign else array


def _text(name: str, value: Any) -> str:
    if value is None or value is np.ma.masked:
        return ""
    if isinstance(value, np.datetime64 | np.timedelta64) and np.isnat(value):
        return ""
    if isinstance(value, float | np.floating):
        if math.isnan(value):
            return ""
        if math.isinf(value):
            return "Inf" if value > 0 else "-Inf"
    writable = str | bool | np.bool_ | numbers.Real | np.datetime64 | datetime.date | datetime.time
    if not isinstance(value, writable) and not isinstance(value, os.PathLike):
        raise TypeError(
            f"Column `{name}` must hold numbers, booleans or text, but holds {describe(value)}. Write parts "
            "(the real and the imaginary one, for example) as separate columns."
        )
    return str(value)
