"""A tissue from the table of its edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from vertax._base.checks import as_float64
from vertax.initialise._polygons import checked_lattice
from vertax.io._read_table import column, whole_numbers
from vertax.mesh import Free, Periodic, Tissue, Topology
from vertax.mesh._faces import Names, Sides, build_faces


def from_edge_table(
    table: Mapping[str, Any],
    *,
    box: ArrayLike | Sequence[Any] | None = None,
    softening: float | None = None,
) -> Tissue:
    """Build a tissue from the table of its edges: the inverse of [`edge_table`][vertax.io.edge_table].

    ```python
    vx.io.write_csv("edges.csv", vx.io.edge_table(tissue))
    again = vx.io.from_edge_table(vx.io.read_table("edges.csv"))
    ```

    Edges of a GeoJSON file (`cells-edges.geojson`) are read in the same way.

    Cells, vertices and edges have the same numbers as before (without spare slots: the same order), edges the
    same direction, and connections and angles are the same. Positions in a free tissue are the same to the
    last bit. Positions in a periodic tissue are in the box, and may differ in the last bit, because the table
    gives them where the cell on the left is.

    **Arguments:**

    - `table`: the columns `left_cell`, `right_cell` (-1: the exterior), `start_vertex`, `end_vertex`,
        `start_x`, `start_y`, `end_x`, `end_y`, and `angle`. A dictionary of arrays or a data frame. Edges are
        arcs if the table has an angle other than 0: inner ones too if one of them has.
    - `box`: of a periodic tissue, width and height, or two lattice vectors as rows; the table does not have
        it.
    - `softening`: passed on to [`Tissue`][vertax.Tissue]; the table does not have it either.

    **Returns:** a [`Tissue`][vertax.Tissue].

    **Raises:**

    - `ValueError`, naming the column, edge, cell or vertex, for a column that is missing or has the wrong
        type, vertices that do not join three edges, cells that are not closed, and for a periodic tissue
        without `box`.
    """
    read = lambda name: whole_numbers(table, name, "table")
    cells = np.stack([read("left_cell"), read("right_cell")], axis=1)
    vertices = np.stack([read("start_vertex"), read("end_vertex")], axis=1)
    ends = np.stack(
        [
            np.stack([as_float64(name, column(table, name, "table")) for name in names], axis=1)
            for names in (("start_x", "start_y"), ("end_x", "end_y"))
        ],
        axis=1,
    )
    angles = as_float64("angle", column(table, "angle", "table"))
    if not len(cells):
        raise ValueError("Argument `table` must have a row for each edge, but has none.")
    exterior = box is None
    _check_cells(cells, exterior)

    vertex_names, vertex = np.unique(vertices, return_inverse=True)
    vertex = vertex.reshape(-1, 2)
    degree = np.bincount(vertex.ravel())
    if np.any(degree != 3):
        bad = int(np.argmax(degree != 3))
        raise ValueError(
            f"Argument `table` must have three edges at each vertex, but has {degree[bad]} at vertex "
            f"{vertex_names[bad]}. Give the rows of all edges of a tissue; polygons of other kinds are "
            "read by "
            "`vx.initialise.from_polygons`."
        )
    lattice = np.zeros((2, 2)) if box is None else checked_lattice(box)
    points = _positions(vertex, ends, None if box is None else lattice)

    # Side 2 e is that of the cell on the left of edge e, in its direction; side 2 e + 1 that on the right.
    cell_names = np.unique(cells[cells >= 0])
    cell = np.where(cells >= 0, np.searchsorted(cell_names, cells), -1).ravel()
    start, end = vertex.ravel(), vertex[:, ::-1].ravel()
    vector = ends[:, 1] - ends[:, 0]
    offset = np.zeros((len(cells), 2), int)
    if box is not None:
        straight = points[vertex[:, 1]] - points[vertex[:, 0]]
        offset = np.rint((vector - straight) @ np.linalg.inv(lattice)).astype(int)
    offset = np.stack([offset, -offset], axis=1).reshape(-1, 2)
    order, image = _outlines(start, end, cell, offset, _directions(vector, angles), cell_names)
    names = Names(
        "Argument `table`",
        lambda point: f"vertex {vertex_names[point]}",
        lambda index: f"cell {cell_names[index]}",
    )
    sides = Sides(start[order], image, cell[order])
    mesh = build_faces(points, sides, names, exterior=exterior)

    m, edge = mesh.topology, np.empty(mesh.topology.n_half_edges, int)
    twin = np.asarray(m.twin)
    edge[mesh.half_edge] = order // 2
    edge[twin[mesh.half_edge]] = order // 2
    topology = Topology(twin, np.asarray(m.cell), np.asarray(m.frame), edge, exterior=exterior)
    half_edge = np.empty(len(cells), int)
    forward = order % 2 == 0
    half_edge[order[forward] // 2] = mesh.half_edge[forward]
    topology = eqx.tree_at(
        lambda t: t.half_edge, topology, jnp.asarray(half_edge, topology.half_edge.dtype)
    )
    dtype = jnp.result_type(float)
    inner = cells[:, 1] >= 0
    return Tissue(
        jnp.asarray(points, dtype),
        topology,
        Free() if box is None else Periodic(jnp.asarray(lattice, dtype)),
        softening,
        angles=jnp.asarray(angles, dtype) if np.any(angles != 0) else None,
        inner_arcs=bool(np.any(angles[inner] != 0)),
    )


def _check_cells(cells: Int[np.ndarray, "edges 2"], exterior: bool) -> None:
    if np.any(cells[:, 0] < 0) or np.any(cells[:, 1] < -1):
        bad = int(np.argmax((cells[:, 0] < 0) | (cells[:, 1] < -1)))
        raise ValueError(
            "Columns `left_cell` and `right_cell` must hold numbers of cells from 0, and -1 only on the "
            "right, "
            f"but row {bad} has {cells[bad, 0]} and {cells[bad, 1]}. Swap the ends of such an edge."
        )
    if exterior and not np.any(cells < 0):
        raise ValueError(
            "Argument `box` is needed for a periodic tissue, and no edge of the table borders on the "
            "exterior. "
            "Pass its width and height, or its two lattice vectors."
        )
    if not exterior and np.any(cells < 0):
        raise ValueError(
            "Argument `box` must be left out for a free tissue, but edge "
            f"{int(np.argmax(cells[:, 1] < 0))} of "
            "the table borders on the exterior."
        )


def _positions(
    vertex: Int[np.ndarray, "edges 2"],
    ends: Float[np.ndarray, "edges 2 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> Float[np.ndarray, "vertices 2"]:
    """Positions of the vertices: where the table gives one in the box, that; else moved into it."""
    flat, places = vertex.ravel(), ends.reshape(-1, 2)
    points = np.empty((flat.max() + 1, 2))
    if lattice is None:
        points[flat] = places
        return points
    image = np.floor(places @ np.linalg.inv(lattice))
    inside = np.all(image == 0, axis=1)
    places = np.where(inside[:, None], places, places - image @ lattice)
    order = np.argsort(inside, kind="stable")
    points[flat[order]] = places[order]  # the last one counts
    return points


def _directions(
    vector: Float[np.ndarray, "edges 2"], angles: Float[np.ndarray, " edges"]
) -> Float[np.ndarray, " sides"]:
    """The angle, from the x axis, at which each side leaves its vertex."""
    chord = np.arctan2(vector[:, 1], vector[:, 0])
    return np.stack([chord - angles, chord + np.pi + angles], axis=1).ravel()


def _outlines(
    start: Int[np.ndarray, " sides"],
    end: Int[np.ndarray, " sides"],
    cell: Int[np.ndarray, " sides"],
    offset: Int[np.ndarray, "sides 2"],
    direction: Float[np.ndarray, " sides"],
    cell_names: Int[np.ndarray, " cells"],
) -> tuple[Int[np.ndarray, " used"], Int[np.ndarray, "used 2"]]:
    """The sides in order around each cell, and the lattice image at which each begins."""
    leaving: dict[tuple[int, int], list[int]] = {}
    first: dict[int, int] = {}
    for side in np.flatnonzero(cell >= 0).tolist():
        leaving.setdefault((int(cell[side]), int(start[side])), []).append(side)
        first.setdefault(int(cell[side]), side)
    count = np.bincount(cell[cell >= 0])
    order, images = [], []
    for index, name in enumerate(cell_names):
        side, image = first[index], np.zeros(2, int)
        for _ in range(count[index]):
            order.append(side)
            images.append(image)
            image = image + offset[side]
            options = leaving.get((index, int(end[side])), [])
            if not options:
                side = -1
                break
            # A cell of a small periodic tissue may have several corners at a vertex: its next side is the
            # next one clockwise of the one that arrives.
            back = direction[side ^ 1]
            side = min(
                options, key=lambda other: (back - direction[other]) % (2 * np.pi) or 2 * np.pi
            )
        closed = side == first[index] and not image.any()
        if not closed or len(set(order[len(order) - count[index] :])) < count[index]:
            raise ValueError(
                f"Argument `table` must list all sides of each cell, but those of cell {name} make no closed "
                "outline. Give the rows of all edges, with the `box` of a periodic tissue."
            )
    return np.array(order), np.array(images)
