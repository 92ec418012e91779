"""A tissue from the table of its edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from vertax._base.checks import as_float64, as_lattice
from vertax.io._read_table import column, whole_numbers
from vertax.io._tables import Tables, frames_of, topology_of
from vertax.mesh import Free, Periodic, Tissue
from vertax.surfaces import HeightMap


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
        arcs if the table has an angle other than 0: inner ones too if one of them has. With columns `start_z`
        and `end_z` the tissue is on the smooth surface through its vertices, see
        [`HeightMap.through`][vertax.surfaces.HeightMap.through].
    - `box`: of a periodic tissue, width and height, or two lattice vectors as rows; the table does not have
        it.
    - `softening`: passed on to [`Tissue`][vertax.Tissue]; the table does not have it either.

    **Returns:** a [`Tissue`][vertax.Tissue].

    **Raises:**

    - `ValueError`, naming the column, edge, cell or vertex, for a column that is missing or has the wrong
        type, vertices that do not join three edges, cells that are not closed, for a periodic tissue without
        its `box`, and for arcs, a box or overhangs in a table with z.
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
    lattice = np.zeros((2, 2)) if box is None else as_lattice(box)
    points = _positions(vertex, ends, None if box is None else lattice)

    # Row 2 e of the paper's half-edge table runs along edge e, row 2 e + 1 against it.
    cell_names = np.unique(cells[cells >= 0])
    face = np.where(cells >= 0, np.searchsorted(cell_names, cells), len(cell_names)).ravel()
    source, target = vertex.ravel(), vertex[:, ::-1].ravel()
    vector = ends[:, 1] - ends[:, 0]
    offset = np.zeros((len(cells), 2), int)
    if box is not None:
        straight = points[vertex[:, 1]] - points[vertex[:, 0]]
        offset = np.rint((vector - straight) @ np.linalg.inv(lattice)).astype(int)
        rest = np.linalg.norm(vector - straight - offset @ lattice, axis=1)
        if rest.max() > 1e-2 * np.sqrt(np.linalg.det(lattice)):
            raise ValueError(
                f"Argument `box` must be the box of the table, but edge {int(np.argmax(rest))} and another "
                f"one at its end are not a lattice vector of {lattice.tolist()} apart. Correct `box`."
            )
    offset = np.stack([offset, -offset], axis=1).reshape(-1, 2)
    following = _following(source, face, _directions(vector, angles, vertex), vertex_names)
    twin = np.arange(len(source)) ^ 1
    columns = [np.argsort(following), following, twin, source, target, face, *offset.T]
    face_table = np.unique(face, return_index=True)[1]
    tables = Tables(points, np.stack(columns, axis=1), face_table, 1.0, 1.0)
    frame = np.zeros_like(offset)
    try:
        if box is not None:
            frame = frames_of(tables, lattice)
        topology = topology_of(tables, frame, exterior=exterior)
    except ValueError as error:
        raise ValueError(
            f"Argument `table` must list all edges of one tissue, but does not: {error} Give the rows of all "
            "edges, with the `box` of a periodic tissue."
        ) from error
    surface = None
    if "start_z" in table:
        z = [as_float64(name, column(table, name, "table")) for name in ("start_z", "end_z")]
        heights = np.empty(len(points))
        heights[vertex] = np.stack(z, axis=1)
        surface = HeightMap.through(np.column_stack([points, heights]))
    dtype = jnp.result_type(float)
    inner = cells[:, 1] >= 0
    return Tissue(
        jnp.asarray(points, dtype),
        topology,
        Free() if box is None else Periodic(jnp.asarray(lattice, dtype)),
        softening,
        angles=jnp.asarray(angles, dtype) if np.any(angles != 0) else None,
        inner_arcs=bool(np.any(angles[inner] != 0)),
        surface=surface,
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
    vector: Float[np.ndarray, "edges 2"],
    angles: Float[np.ndarray, " edges"],
    vertex: Int[np.ndarray, "edges 2"],
) -> Float[np.ndarray, " rows"]:
    """The angle, from the x axis, at which each row leaves its vertex."""
    chord = np.arctan2(vector[:, 1], vector[:, 0])
    direction = np.stack([chord - angles, chord + np.pi + angles], axis=1)
    # An edge of length 0 points away from the other edges at its other end, as in a four-fold vertex that
    # it is a part of: it separates them from those at its own end.
    length = np.linalg.norm(vector, axis=1)
    for edge in np.flatnonzero(length <= 1e-12 * length.max()):
        for end in (0, 1):
            beyond = (vertex == vertex[edge, 1 - end]) & (np.arange(len(vertex)) != edge)[:, None]
            x, y = np.cos(direction[beyond]).sum(), np.sin(direction[beyond]).sum()
            direction[edge, end] = np.arctan2(y, x)
    return direction.ravel()


def _following(
    source: Int[np.ndarray, " rows"],
    face: Int[np.ndarray, " rows"],
    direction: Float[np.ndarray, " rows"],
    vertex_names: Int[np.ndarray, " vertices"],
) -> Int[np.ndarray, " rows"]:
    """The next row of the face of each row."""
    # Counter-clockwise around a vertex, the face on the left of a row is on the right of the next one. One
    # of the two orders of the three rows satisfies that; both do only where faces repeat, as in periodic
    # tissues of a few cells: there the directions decide.
    leaving = np.argsort(source, kind="stable").reshape(-1, 3)
    left, right = face[leaving], face[leaving ^ 1]
    ordered = np.all(left == right[:, [1, 2, 0]], axis=1)
    reversed_order = np.all(left == right[:, [2, 0, 1]], axis=1)
    neither = np.flatnonzero(~ordered & ~reversed_order)
    if neither.size:
        raise ValueError(
            "Argument `table` must have the same cell on both sides of each corner, but the cells at vertex "
            f"{vertex_names[neither[0]]} contradict each other. Correct `left_cell` and `right_cell` there."
        )
    turn = (direction[leaving] - direction[leaving[:, :1]]) % (2 * np.pi)
    reverse = np.where(ordered & reversed_order, turn[:, 1] > turn[:, 2], reversed_order)
    leaving = np.where(reverse[:, None], leaving[:, [0, 2, 1]], leaving)
    following = np.empty_like(source)
    # After a row that arrives, the face goes on with the row one step clockwise of its twin.
    following[leaving ^ 1] = leaving[:, [2, 0, 1]]
    return following
