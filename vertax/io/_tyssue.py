"""Tissues from the data frames of tyssue."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Int

from vertax._base.checks import as_float64, describe
from vertax.initialise import PolygonTissue
from vertax.initialise._faces import Names
from vertax.initialise._polygons import tissue_from_corners
from vertax.io._read_table import column, read_table, whole_numbers

_TABLES = ("vert", "edge", "face")


def from_tyssue(
    datasets: Mapping[str, Any],
    *,
    box: ArrayLike | Sequence[Any] | None = None,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> PolygonTissue:
    """Tissue from the vertex, edge and face tables of tyssue (Theis, Suzanne & Gay 2021,
    doi:10.21105/joss.02973).

    ```python
    polygons = vx.io.from_tyssue(sheet.datasets)
    polygons = vx.io.from_tyssue(tyssue.io.hdf5.load_datasets("sheet.hf5"))
    polygons = vx.io.from_tyssue({"vert": "vert.csv", "edge": "edge.csv", "face": "face.csv"})
    ```

    Each row of the edge table is a half-edge. What becomes of points where two or more than three edges meet,
    and of columns `z` (not constant: free sheets without overhangs), is described at
    [`from_polygons`][vertax.initialise.from_polygons].

    Values go with the rows: `face_df["prefered_area"].to_numpy()[polygons.cells]` has one entry a cell, and
    `polygons.side_edges` is the edge of each row of the edge table. An inner edge has two rows, and in tyssue
    its line tension is the sum of theirs divided by two.

    **Arguments:**

    - `datasets`: the tables `"vert"` (columns `x`, `y`), `"edge"` (columns `srce`, `trgt`, `face`) and
        `"face"`: data frames, dictionaries of columns, or CSV files. Rows are numbered by the index of a data
        frame; in a file by its column `vert`, `edge` or `face`, or by the one without a name, or else from 0.
        `"face"` may be left out, then faces are those of the edge table, ascending.
    - `box`: of a periodic sheet, width and height: the differences of the limits in
        `sheet.settings["boundaries"]`.
    - `inner_arcs`, `softening`: as of [`from_polygons`][vertax.initialise.from_polygons].

    **Returns:** a [`PolygonTissue`][vertax.initialise.PolygonTissue]: `cells` and `points` are rows of the
    face and vertex tables, from 0, and `side_edges` has the order of the edge table.

    **Raises:**

    - `ValueError` for tables or columns that are missing, edges of a vertex or face that does not
        exist, faces without a closed outline, and as
        [`from_polygons`][vertax.initialise.from_polygons].
    - `TypeError` for something else than tables.
    """
    if not isinstance(datasets, Mapping):
        raise TypeError(
            "Argument `datasets` must hold the tables by name, such as sheet.datasets or {'vert': vert_df, "
            f"'edge': edge_df, 'face': face_df}}, but is {describe(datasets)}."
        )
    missing = [name for name in ("vert", "edge") if name not in datasets]
    if missing:
        raise ValueError(
            "Argument `datasets` must hold the tables vert, edge and face, but has no "
            f"{' and no '.join(missing)}. "
            f"It has: {', '.join(map(str, datasets)) or 'nothing'}."
        )
    tables = {
        name: read_table(datasets[name])
        if isinstance(datasets[name], str | os.PathLike)
        else datasets[name]
        for name in _TABLES
        if name in datasets
    }
    vert, edge = tables["vert"], tables["edge"]
    points = np.stack([as_float64(axis, column(vert, axis, "vert")) for axis in "xy"], axis=1)
    if "z" in vert:
        points = np.column_stack([points, as_float64("z", column(vert, "z", "vert"))])
    srce, trgt, face = (whole_numbers(edge, name, "edge") for name in ("srce", "trgt", "face"))
    vert_numbers = _index(vert, "vert", len(points))
    has_faces = "face" in tables
    face_numbers = _index(tables["face"], "face", None) if has_faces else np.unique(face)
    start = _rows(srce, vert_numbers, "srce", "vert")
    end = _rows(trgt, vert_numbers, "trgt", "vert")
    owner = _rows(face, face_numbers, "face", "face")
    unused = np.setdiff1d(np.arange(len(face_numbers)), owner)
    if unused.size:
        raise ValueError(
            f"Table `face` must have edges for each row, but face {face_numbers[unused[0]]} has none. "
            "Reset the "
            "sheet's index and topology first: sheet.reset_index(), sheet.reset_topo()."
        )

    cells, order = _outlines(start, end, owner, face_numbers)
    names = Names(
        "Argument `datasets`",
        lambda point: f"vertex {vert_numbers[point]}",
        lambda cell: f"face {face_numbers[cell]}",
    )
    settings = {"box": box, "inner_arcs": inner_arcs, "softening": softening}
    result = tissue_from_corners(points, cells, names, **settings)
    side_edges = np.empty(len(order), int)
    side_edges[order] = result.side_edges
    return dataclasses.replace(result, side_edges=side_edges)


def _index(table: Any, name: str, length: int | None) -> Int[np.ndarray, " rows"]:
    """The numbers of the rows of a table."""
    if hasattr(table, "index") and not isinstance(table, Mapping):
        return np.asarray(table.index).astype(int)
    for candidate in (name, ""):
        if candidate in table:
            return whole_numbers(table, candidate, name)
    if length is None:
        length = len(next(iter(table.values()), ()))
    return np.arange(length)


def _rows(
    numbers: Int[np.ndarray, " edges"], index: Int[np.ndarray, " rows"], name: str, table: str
) -> Int[np.ndarray, " edges"]:
    """The rows of a table that a column of the edge table refers to."""
    order = np.argsort(index)
    place = np.minimum(np.searchsorted(index, numbers, sorter=order), max(len(index) - 1, 0))
    rows = order[place] if len(index) else np.zeros(len(numbers), int)
    wrong = np.flatnonzero(index[rows] != numbers) if len(index) else np.arange(len(numbers))
    if wrong.size:
        raise ValueError(
            f"Column `{name}` of table `edge` must hold numbers of rows of table `{table}`, but holds "
            f"{numbers[wrong[0]]}, which is none. Reset the sheet's index first: sheet.reset_index()."
        )
    return rows


def _outlines(
    start: Int[np.ndarray, " edges"],
    end: Int[np.ndarray, " edges"],
    owner: Int[np.ndarray, " edges"],
    face_numbers: Int[np.ndarray, " faces"],
) -> tuple[list[Int[np.ndarray, " _"]], Int[np.ndarray, " edges"]]:
    """The corners of each face in order, and the rows of the edge table in that order."""
    leaving = {
        (int(cell), int(point)): row
        for row, (cell, point) in enumerate(zip(owner, start, strict=True))
    }
    first = np.unique(owner, return_index=True)[1]
    count = np.bincount(owner)
    cells, order = [], []
    for cell, row in enumerate(first.tolist()):
        rows = [row]
        while len(rows) < count[cell]:
            row = leaving.get((cell, int(end[row])), -1)
            if row < 0 or row == rows[0]:
                break
            rows.append(row)
        if len(rows) < count[cell] or end[rows[-1]] != start[rows[0]] or len(set(rows)) < len(rows):
            raise ValueError(
                "Table `edge` must list the edges around each face, but those of face "
                f"{face_numbers[cell]} make no "
                "closed outline. Check `srce`, `trgt` and `face`; sheet.sanitize() removes such faces."
            )
        cells.append(start[np.array(rows)])
        order += rows
    return cells, np.array(order)
