"""The paper's tables: `vertTable`, `heTable`, `faceTable` and, of a bounded tissue, `angTable`."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vertax._base.checks import check_instance, check_number
from vertax._base.model_checks import check_planar
from vertax.io._bounded_tables import (
    BoundedTables,
    checked,
    checked_table,
    with_exterior,
    without_exterior,
)
from vertax.io._data_tables import check_writable
from vertax.mesh import Free, Periodic, Tissue, Topology


class Tables(NamedTuple):
    """A periodic rectangular tissue in the form of the paper's files.

    NumPy arrays; rows of `he_table` are half-edges, in any order.

    **Arguments:**

    - `vert_table`: positions of the vertices, in units of length.
    - `he_table`: the columns are previous, next and twin half-edge, source and target vertex, the
        face on the left, and the offset of the target in x and in y, in boxes (−1, 0, +1) relative
        to the source. Faces are counter-clockwise.
    - `face_table`: one half-edge of each face.
    - `width`, `height`: the box, with a corner at the origin.
    """

    vert_table: Float[np.ndarray, "vertices 2"]
    he_table: Int[np.ndarray, "halfedges 8"]
    face_table: Int[np.ndarray, " faces"]
    width: float
    height: float

    @property
    def edges(self) -> Int[np.ndarray, " halfedges"]:
        """Edge number of each row of `he_table` in the tissue that `from_tables` makes.

        Edges are numbered by their first row. So values per half-edge become values per edge as
        `per_edge[tables.edges] = values` (where twins agree), and `per_edge[tables.edges]` leads
        back.
        """
        twin = np.asarray(self.he_table)[:, 2]
        first = np.minimum(np.arange(len(twin)), twin)
        return np.unique(first, return_inverse=True)[1]

    @property
    def half_edges(self) -> Int[np.ndarray, " halfedges"]:
        """Half-edge that each row of `he_table` is in the tissue that `from_tables` makes."""
        previous, _, twin, source = np.asarray(self.he_table)[:, :4].T
        rows = np.arange(len(source))
        # The first row that leaves a vertex takes its first slot, the others follow
        # counter-clockwise.
        first = np.full(len(source) // 3, -1)
        first[source[::-1]] = rows[::-1]
        half_edges = np.empty_like(rows)
        row = first
        for slot in range(3):
            half_edges[row] = 3 * np.arange(len(first)) + slot
            row = twin[previous[row]]
        return half_edges


def from_tables(tables: Tables | BoundedTables, *, softening: float | None = None) -> Tissue:
    """Make a tissue from the paper's tables.

    Vertices and cells keep their numbers. Edges are numbered and directed by their first row of
    `he_table`; [`Tables.edges`][vertax.io.Tables] and `Tables.half_edges` map arrays along the rows
    to the tissue's edges and half-edges.

    ```python
    data = np.load("paper.npz")
    tables = vx.io.Tables(
        data["vertTable"], data["heTable"], data["faceTable"], data["width"], data["height"]
    )
    tissue = vx.io.from_tables(tables)
    ```

    **Arguments:**

    - `tables`: the [`Tables`][vertax.io.Tables], or the [`BoundedTables`][vertax.io.BoundedTables] of
        a free tissue (its cell types are not stored in the tissue).
    - `softening`: passed on to [`Tissue`][vertax.Tissue]; the paper's code has none, that is 0.

    **Returns:** a [`Tissue`][vertax.Tissue] with a rectangular [`Periodic`][vertax.Periodic]
    boundary, or a [`Free`][vertax.Free] one.

    **Raises:**

    - `ValueError` naming the table and the first rows at fault, if tables have the wrong shape or
        contradict themselves or each other, if a vertex does not join exactly three edges, or if
        the faces are not counter-clockwise and cover the box once.
    """
    if isinstance(tables, BoundedTables):
        return _from_bounded_tables(tables, softening)
    remedy = "Write Tables(vert_table, he_table, face_table, width, height)."
    check_instance("tables", tables, Tables, "vertax.io.Tables or BoundedTables", remedy)
    tables = _checked(tables)
    _check_rows(tables)
    lattice = np.diag([tables.width, tables.height])
    topology = topology_of(tables, frames_of(tables, lattice), exterior=False)
    dtype = _dtype(tables.vert_table)
    vertices, boundary = (
        jnp.asarray(tables.vert_table, dtype),
        Periodic(jnp.asarray(lattice, dtype)),
    )
    return Tissue(vertices, topology, boundary, softening)


def _from_bounded_tables(tables: BoundedTables, softening: float | None) -> Tissue:
    tables = checked(tables)
    vert_table, ang_table, *_ = tables
    he_table, face_table = with_exterior(tables)
    closed = Tables(vert_table, he_table, face_table, 1.0, 1.0)
    _check_rows(closed)
    topology = topology_of(closed, np.zeros((len(he_table), 2), int), exterior=True)
    # The sign of the area gives the sense of rotation of the faces.
    x, y = vert_table[he_table[:, 3]].T
    u, v = vert_table[he_table[:, 4]].T
    cover = 0.5 * np.sum((x * v - y * u)[he_table[:, 5] < len(tables.face_table)])
    if not cover > 0:
        raise ValueError(
            "The faces of `he_table` must run counter-clockwise, but their signed areas sum to "
            f"{cover:.3g}."
        )
    dtype = _dtype(vert_table)
    vertices, angles = jnp.asarray(vert_table, dtype), jnp.asarray(ang_table, dtype)
    return Tissue(vertices, topology, Free(), softening, angles=angles)


def topology_of(tables: Tables, frame: np.ndarray, *, exterior: bool) -> Topology:
    """The topology of tables with the lattice image `frame` of each row; an exterior is the last face."""
    twin, face = tables.he_table[:, 2], tables.he_table[:, 5]
    # Row r of the table is half-edge number[r]; `row` is the inverse.
    number = tables.half_edges
    row = np.argsort(number)
    edges = tables.edges
    topology = Topology(number[twin][row], face[row], frame[row], edges[row], exterior=exterior)
    first_rows = np.unique(edges, return_index=True)[1]
    if exterior:
        outside = face[first_rows] == len(tables.face_table) - 1
        first_rows = np.where(outside, twin[first_rows], first_rows)
    return eqx.tree_at(
        lambda m: m.half_edge, topology, jnp.asarray(number[first_rows], topology.half_edge.dtype)
    )


def _dtype(positions: np.ndarray) -> Any:
    """float32 for float32 positions, otherwise the default precision of JAX."""
    return np.float32 if positions.dtype == np.float32 else jnp.result_type(float)


def to_tables(tissue: Tissue) -> Tables | BoundedTables:
    """Write a tissue as the paper's tables.

    Vertices and cells keep their numbers; edge `e` becomes rows `2 e` (in the edge's direction) and
    `2 e + 1`, as in the paper's files, so `np.repeat(values, 2)` takes values per edge to the rows.
    Spare slots are left out, and the rest is renumbered in order. Vertices outside the box are moved into it
    by multiples of its sides; the others keep their bits. The tables have no softening.

    **Arguments:**

    - `tissue`: a [`Tissue`][vertax.Tissue] in a rectangular periodic box, or a free one with straight
        inner edges.

    **Returns:** the [`Tables`][vertax.io.Tables], or the [`BoundedTables`][vertax.io.BoundedTables] of
    a free tissue (all cells of type 0).

    **Raises:**

    - `ValueError` for a batch of tissues, for a tissue on a surface, for arcs that tables cannot hold, if the
        box is sheared or its first vector is not along x, or an edge reaches beyond the neighbouring box.
    """
    check_writable(tissue)
    check_planar("tables, which have two coordinates (save keeps the surface)", tissue)
    tissue = tissue.without_spare()
    if tissue.inner_arcs:
        raise ValueError("Tables hold arcs on the outline only. Use `vx.save`, which keeps all.")
    boundary = tissue.boundary
    if isinstance(boundary, Free):
        angles = np.asarray(tissue.edge_angles if tissue.angles is None else tissue.angles)
        he_table = _rows(tissue.topology, np.zeros((tissue.topology.n_half_edges, 2), int))
        return without_exterior(np.asarray(tissue.vertices), angles, he_table, tissue.n_cells)
    if not isinstance(boundary, Periodic):
        raise ValueError(
            f"Tables hold periodic and free tissues, but the boundary is {type(boundary).__name__}."
        )
    lattice = np.asarray(boundary.lattice)
    if lattice[0, 1] != 0 or lattice[1, 0] != 0:
        raise ValueError(
            "Tables hold rectangular boxes only (lattice vectors along x and y), but the lattice "
            f"is {lattice.tolist()}. Use `vx.save`, which keeps any lattice."
        )
    size = np.diag(lattice)
    m = tissue.topology
    vertices = np.asarray(tissue.vertices)
    image = np.floor(vertices / size).astype(int)
    wrapped = np.where(image == 0, vertices, vertices - image.astype(size.dtype) * size)
    frame, following, source, target = (
        np.asarray(x) for x in (m.frame, m.next, m.source, m.target)
    )
    offset = frame[following] - frame + image[target] - image[source]
    if np.abs(offset).max() > 1:
        far = int(np.argmax(np.abs(offset).max(axis=1)))
        raise ValueError(
            "Tables hold edges that reach into a neighbouring box at most, but the edge from "
            f"vertex {source[far]} to vertex {target[far]} goes {offset[far].tolist()} boxes."
        )
    he_table = _rows(m, offset).astype(np.int32)
    face_table = np.unique(he_table[:, 5], return_index=True)[1].astype(np.int32)
    return Tables(wrapped, he_table, face_table, float(size[0]), float(size[1]))


def _rows(m: Topology, offset: Int[np.ndarray, "halfedges 2"]) -> Int[np.ndarray, "halfedges 8"]:
    """The half-edge table; rows 2 e and 2 e + 1 are the two half-edges of edge e."""
    half_edge, twin, following = (np.asarray(x) for x in (m.half_edge, m.twin, m.next))
    order = np.stack([half_edge, twin[half_edge]], axis=1).ravel()
    row = np.argsort(order)
    source, target = np.arange(m.n_half_edges) // 3, twin // 3
    previous = np.argsort(following)  # the inverse permutation
    columns = [row[previous], row[following], row[twin]]
    columns += [source, target, np.asarray(m.cell), offset[:, 0], offset[:, 1]]
    return np.stack(columns, axis=1)[order]


def _checked(tables: Tables) -> Tables:
    """The tables as arrays of the right shapes and types."""
    check_number("width", _number(tables.width), above=0)
    check_number("height", _number(tables.height), above=0)
    v = checked_table("vert_table", tables.vert_table, "finite positions", "(vertices, 2)")
    he = checked_table("he_table", tables.he_table, "integers", "(half-edges, 8)")
    remedy = " (For bounded tissues pass `BoundedTables`.)"
    f = checked_table("face_table", tables.face_table, "integers", "(faces,)", remedy)
    return Tables(v, he, f, float(tables.width), float(tables.height))


def _number(value: Any) -> Any:
    """A number that a file may hold as an array with one entry."""
    array = isinstance(value, np.ndarray) and value.size == 1
    return value.reshape(()) if array else value


def _check_rows(tables: Tables) -> None:
    """Check that the columns are within range and agree with each other."""
    previous, following, twin, source, target, face, *_ = tables.he_table.T
    offset = tables.he_table[:, 6:]
    n_rows, n_vertices, n_faces = len(source), len(tables.vert_table), len(tables.face_table)
    rows = np.arange(n_rows)

    def require(ok: np.ndarray, what: str, table: str = "he_table", at: str = "rows"):
        if not np.all(ok):
            bad = np.flatnonzero(~ok)[:3].tolist()
            raise ValueError(f"Table `{table}` is broken: {what} (first offenders: {at} {bad}).")

    for column, bound, name in (
        (previous, n_rows, "previous"),
        (following, n_rows, "next"),
        (twin, n_rows, "twin"),
        (source, n_vertices, "source"),
        (target, n_vertices, "target"),
        (face, n_faces, "face"),
    ):
        require((column >= 0) & (column < bound), f"`{name}` must lie in 0 … {bound - 1}")
    edges_at_vertex = np.bincount(source, minlength=n_vertices)
    require(
        edges_at_vertex == 3,
        "every vertex must join exactly three edges, so the tissue can hold no rosettes",
        at="vertices",
    )
    require((twin[twin] == rows) & (twin != rows), "`twin` must pair up the rows")
    require(previous[following] == rows, "`previous` must undo `next`")
    require(source[twin] == target, "`target` must be the source of the twin")
    require(source[following] == target, "`next` must leave from `target`")
    require(face[following] == face, "`face` must be the same all around a face")
    require(np.all(offset[twin] == -offset, axis=1), "twins must have opposite offsets")
    # `twin[previous]` turns around a vertex and permutes its three rows; without a fixed point that
    # is a full turn.
    require(twin[previous] != rows, "no row may follow its own twin")
    require(
        (tables.face_table >= 0) & (tables.face_table < n_rows),
        f"entries must lie in 0 … {n_rows - 1}",
        table="face_table",
        at="faces",
    )
    require(
        face[tables.face_table] == np.arange(n_faces),
        "each entry must be a half-edge of its face",
        table="face_table",
        at="faces",
    )


def frames_of(tables: Tables, lattice: Float[np.ndarray, "2 2"]) -> Int[np.ndarray, "halfedges 2"]:
    """Box of each row's source, relative to the first row of its face, in a lattice that faces cover once.

    Sums the offsets around all faces at once, one side at a time.
    """
    he_table, start = tables.he_table, tables.face_table
    following, offset = he_table[:, 1], he_table[:, 6:]
    frame = np.zeros_like(offset)
    row, image = start, np.zeros((len(start), 2), offset.dtype)
    for _ in range(np.bincount(he_table[:, 5]).max()):
        frame[row] = image
        image = image + offset[row]
        row = following[row]
        # At its first row a face must be in its first box again.
        closed = row == start
        broken = np.flatnonzero(closed & np.any(image != 0, axis=1))
        if broken.size:
            raise ValueError(
                "Table `he_table` is broken: offsets must add up to zero around every face (first "
                f"offenders: faces {broken[:3].tolist()})."
            )
    # The faces of a torus cover it a whole number of times, whatever their shapes: -1 if they all
    # run clockwise, and something else if offsets are wrong in a way that happens to close around
    # each face. (Shoelace formula, in NumPy: it would be a dozen small compilations.)
    x, y = (tables.vert_table[he_table[:, 3]] + frame @ lattice).T
    cover = 0.5 * np.sum(x * y[following] - y * x[following]) / np.linalg.det(lattice)
    if abs(cover - 1) > 1e-2:
        raise ValueError(
            "The faces of `he_table` must run counter-clockwise and cover the box once, but their "
            f"signed areas sum to {cover:.3g} boxes."
        )
    return frame
