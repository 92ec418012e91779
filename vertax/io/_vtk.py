"""VTK files of cells and edges, for ParaView."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vertax._base.atomic import atomic_draft
from vertax._base.extras import requires_extra
from vertax.io._data_tables import Column, cell_columns, edge_columns
from vertax.io._geojson import checked_drawing, edge_path
from vertax.io._triangles import is_convex, triangulate
from vertax.mesh import Tissue
from vertax.surfaces import AbstractSurface

_SUFFIXES = (".vtu", ".vtk")


def write_vtk(
    path: str | os.PathLike[str],
    tissue: Tissue,
    *,
    cells: Mapping[str, Column] | None = None,
    edges: Mapping[str, Column] | None = None,
    points_per_arc: int = 24,
) -> None:
    """Write the cells of a tissue for ParaView and PyVista, through meshio.

    A convex cell is a polygon. Any other cell is several triangles: VTK integrates over a polygon as a fan of
    triangles about its first corner, which overlaps the neighbours, and some versions draw it so. Periodic
    cells are drawn in one piece, as in pictures. The data of the elements are the columns of
    [`cell_table`][vertax.io.cell_table], in its order; all triangles of a cell have the row of the cell, and
    `cell` is its number. A tissue on a surface has its points in space. The file is written atomically.

    ```python
    vx.io.write_vtk("tissue.vtu", tissue, cells={"pressure": pressure}, edges={"tension": tension})
    ```

    **Arguments:**

    - `path`: the file, which ends in `.vtu` (XML, compressed) or `.vtk` (legacy).
    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `cells`: more numbers of the cells by name, one entry for each cell.
    - `edges`: numbers of the edges. If given (an empty `{}` too), the edges are written with the columns of
        [`edge_table`][vertax.io.edge_table] to a second file, `tissue-edges.vtu` next to `tissue.vtu`.
        Edges across a periodic boundary occur twice, once at each cell.
    - `points_per_arc`: number of straight pieces of an arc.

    **Raises:**

    - `ImportError` if meshio is not installed: `pip install -e ".[files]"`.
    - `ValueError` for another ending, values that are not numbers, a batch of tissues, `points_per_arc`
        below 1, and as [`cell_table`][vertax.io.cell_table].
    """
    with requires_extra("files", "Writing VTK files"):
        import meshio
    if Path(path).suffix not in _SUFFIXES:
        raise ValueError(
            f"Argument `path` must end in {' or '.join(_SUFFIXES)}, but is {os.fspath(path)!r}."
        )
    drawing = checked_drawing(tissue, points_per_arc)
    polygons, counts = drawing.polygons()
    corners = [polygon[:n] for polygon, n in zip(polygons, counts, strict=True) if n > 0]
    table = cell_columns(tissue, drawing, {} if cells is None else cells)
    surface = tissue.surface
    files = {Path(path): _mesh(np.concatenate(corners), _cell_blocks(corners), table, surface)}
    if edges is not None:
        lines, shown = drawing.sides(np.ones(tissue.n_cells, bool))
        table = edge_columns(tissue, drawing, edges)
        # meshio has no polylines: each piece is one element.
        pieces = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
        row = np.cumsum(drawing.alive_edges) - 1
        ends = np.arange(pieces.size // 2).reshape(-1, 2)
        owner = np.repeat(row[shown], pieces.shape[1])
        block = _Block("line", ends, owner)
        files[edge_path(path)] = _mesh(pieces.reshape(-1, 2), [block], table, surface)
    for place, mesh in files.items():
        _write(place, meshio.Mesh(*mesh))


class _Block(NamedTuple):
    """Elements of one kind and size."""

    kind: str
    corners: Int[np.ndarray, "elements corners"]
    row: Int[np.ndarray, " elements"]
    """Rows of the elements in the table."""


def _cell_blocks(polygons: list[Float[np.ndarray, "_ 2"]]) -> list[_Block]:
    """Convex cells as polygons and others as triangles, with global corner numbers."""
    elements, first = [], 0
    for row, polygon in enumerate(polygons):
        kind, corners = "polygon", np.arange(len(polygon))[None]
        if not is_convex(polygon):
            kind, corners = "triangle", triangulate(polygon)
        elements += [(kind, first + each, row) for each in corners]
        first += len(polygon)
    # Successive elements of one kind and size share a block, so the order of the cells stays.
    groups = itertools.groupby(elements, lambda element: (element[0], len(element[1])))
    blocks = [(kind, list(block)) for (kind, _), block in groups]
    return [
        _Block(kind, np.stack([each[1] for each in block]), np.array([each[2] for each in block]))
        for kind, block in blocks
    ]


def _mesh(
    plane: Float[np.ndarray, "points 2"],
    blocks: list[_Block],
    table: dict[str, np.ndarray],
    surface: AbstractSurface | None,
) -> tuple[np.ndarray, list[Any], None, dict[str, Any]]:
    """Points, blocks of elements, no data of points, and data of the elements by block."""
    points = np.column_stack([plane, np.zeros(len(plane))])
    if surface is not None:
        points = np.asarray(surface.points(jnp.asarray(plane)), float)
    data = {
        name: [_numbers(name, column)[block.row] for block in blocks]
        for name, column in table.items()
        if name not in ("x", "y")
    }
    return points, [(block.kind, block.corners) for block in blocks], None, data


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype.kind == "b":
        return column.astype(np.uint8)
    if column.dtype.kind not in "iuf" or column.dtype == np.float16:
        raise ValueError(
            f"Column `{name}` must hold numbers or booleans, the types of VTK files, but its "
            f"type is {column.dtype}."
        )
    return column


def _write(path: Path, mesh: Any) -> None:
    # meshio writes to a path, not to an open file.
    with atomic_draft(path) as draft:
        mesh.write(draft)
