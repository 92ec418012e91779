"""Cells and edges as meshes of the Visualization Toolkit, for ParaView."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vertax._base.atomic import atomic_draft
from vertax._base.extras import needing
from vertax.io._data_tables import Column, cell_columns, edge_columns
from vertax.io._geojson import checked_drawing, edge_path
from vertax.mesh import Tissue

_SUFFIXES = (".vtu", ".vtk")


def write_vtk(
    path: str | os.PathLike[str],
    tissue: Tissue,
    *,
    cells: Mapping[str, Column] | None = None,
    edges: Mapping[str, Column] | None = None,
    points_per_arc: int = 24,
) -> None:
    """Write the cells of a tissue as polygons for ParaView, through meshio.

    Periodic cells are whole, as in pictures. The cell data are the columns of
    [`cell_table`][vertax.io.cell_table], in its order. The file is written atomically.

    ```python
    vx.io.write_vtk("tissue.vtu", tissue, cells={"pressure": pressure}, edges={"tension": tension})
    ```

    **Arguments:**

    - `path`: the file, which ends in `.vtu` (XML, compressed) or `.vtk` (legacy).
    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `cells`: more numbers on the cells by name, one entry a cell.
    - `edges`: numbers on the edges. If given (`{}` will do), the edges are written with the columns of
        [`edge_table`][vertax.io.edge_table] to a second file, `tissue-edges.vtu` next to `tissue.vtu`.
        Edges across a periodic boundary are there twice, once at either cell.
    - `points_per_arc`: number of straight pieces of an arc.

    **Raises:**

    - `ImportError` if meshio is not installed: `pip install "vertax[files]"`.
    - `ValueError` for another ending, values that are no numbers, a batch of tissues, less than one
        point an arc, and as [`cell_table`][vertax.io.cell_table].
    """
    with needing("files", "Writing VTK files"):
        import meshio
    if Path(path).suffix not in _SUFFIXES:
        raise ValueError(
            f"Argument `path` must end in {' or '.join(_SUFFIXES)}, but is {os.fspath(path)!r}."
        )
    drawing = checked_drawing(tissue, points_per_arc)
    polygons, counts = drawing.polygons()
    corners = [polygon[:n] for polygon, n in zip(polygons, counts, strict=True) if n > 0]
    meshes = {
        Path(path): (
            "polygon",
            corners,
            cell_columns(tissue, drawing, {} if cells is None else cells),
        )
    }
    if edges is not None:
        lines, shown = drawing.sides(np.ones(tissue.n_cells, bool))
        table = edge_columns(tissue, drawing, edges)
        # meshio has no lines of many pieces: each piece is an element of its own.
        pieces = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
        row = np.cumsum(drawing.alive_edges) - 1
        owner = np.repeat(row[shown], pieces.shape[1])
        table = {name: column[owner] for name, column in table.items()}
        meshes[edge_path(path)] = ("line", list(pieces.reshape(-1, 2, 2)), table)
    files = {
        place: meshio.Mesh(*_elements(kind, shapes, table))
        for place, (kind, shapes, table) in meshes.items()
    }
    for place, mesh in files.items():
        _write(place, mesh)


def _elements(
    kind: str, shapes: list[np.ndarray], table: dict[str, np.ndarray]
) -> tuple[np.ndarray, list[Any], None, dict[str, Any]]:
    """Points, blocks of elements, no data of points, and data of the elements by block."""
    plane = np.concatenate(shapes)
    points = np.column_stack([plane, np.zeros(len(plane))])
    blocks, runs, first, row = [], [], 0, 0
    # A block holds elements of one size; neighbours of one size share one, so their order stays.
    for size, group in itertools.groupby(shapes, len):
        n = len(list(group))
        blocks.append((kind, first + np.arange(n * size).reshape(n, size)))
        runs.append(slice(row, row + n))
        first, row = first + n * size, row + n
    data = {
        name: [_numbers(name, column)[run] for run in runs]
        for name, column in table.items()
        if name not in ("x", "y")
    }
    return points, blocks, None, data


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype.kind == "b":
        return column.astype(np.uint8)
    if column.dtype.kind not in "iuf" or column.dtype == np.float16:
        raise ValueError(
            f"Column `{name}` must hold numbers or booleans, which is all that VTK files have, but its "
            f"type is {column.dtype}."
        )
    return column


def _write(path: Path, mesh: Any) -> None:
    # meshio writes to a name and not to an open file.
    with atomic_draft(path) as draft:
        mesh.write(draft)
