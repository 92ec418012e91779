"""The paper's tables of a bounded tissue: the outline is made of arcs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

# The number of the first vertex in these tables: 0 and 1 stand for no vertex.
_FIRST_VERTEX = 2


class BoundedTables(NamedTuple):
    """A free tissue in the form of the paper's files.

    NumPy arrays. Rows `2 e` and `2 e + 1` of `he_table` are the half-edges of edge `e`.

    **Arguments:**

    - `vert_table`: positions of the vertices, in units of length.
    - `ang_table`: the angle of each edge's arc; any number for straight edges.
    - `he_table`: the columns are previous, next and twin half-edge; source and target vertex of an
        inner edge, or 0 and 1; source and target of an arc, or 0 and 1; the face on the left. Vertices
        are numbered from 2. Faces are counter-clockwise. The row of the exterior side of an arc is zero
        except for its twin.
    - `face_table`: one half-edge of each face, and the type of the cell.
    """

    vert_table: Float[np.ndarray, "vertices 2"]
    ang_table: Float[np.ndarray, " edges"]
    he_table: Int[np.ndarray, "halfedges 8"]
    face_table: Int[np.ndarray, "faces 2"]


def with_exterior(tables: BoundedTables) -> tuple[np.ndarray, np.ndarray]:
    """The half-edge and face tables of a closed surface, the exterior as the last face.

    In the form of the periodic tables, with offsets 0.
    """
    he, faces = tables.he_table, tables.face_table[:, 0]
    previous, following, twin = he[:, 0].copy(), he[:, 1].copy(), he[:, 2]
    rows = np.arange(len(he))
    if len(he) != 2 * len(tables.ang_table) or not np.array_equal(twin, rows ^ 1):
        raise ValueError(
            "Table `he_table` is broken: `twin` must pair up rows 2 e and 2 e + 1, one pair for each entry "
            "of `ang_table`."
        )
    outside = (he[:, 3] < _FIRST_VERTEX) & (he[:, 5] < _FIRST_VERTEX)
    if not outside.any() or np.any(outside & outside[twin]):
        raise ValueError(
            "Table `he_table` is broken: an edge must have a face on one side at least, and some the "
            "exterior on the other."
        )
    ends = np.where(he[:, 3:4] < _FIRST_VERTEX, he[:, 5:7], he[:, 3:5]) - _FIRST_VERTEX
    ends = np.where(outside[:, None], ends[twin][:, ::-1], ends)
    # Around the exterior, the next half-edge leaves the vertex at which this one ends.
    leaving = np.full(len(tables.vert_table), -1)
    leaving[ends[outside, 0]] = rows[outside]
    following[outside] = leaving[ends[outside, 1]]
    previous[following[outside]] = rows[outside]
    face = np.where(outside, len(faces), he[:, 7])
    columns = [previous, following, twin, ends[:, 0], ends[:, 1], face, 0 * face, 0 * face]
    return np.stack(columns, axis=1), np.append(faces, np.argmax(outside))


def without_exterior(
    vertices: np.ndarray, angles: np.ndarray, he_table: np.ndarray, n_cells: int
) -> BoundedTables:
    """The reverse of `with_exterior`; all cells are of type 0."""
    twin, source, target, face = he_table[:, 2:6].T
    ends = np.stack([source, target], axis=1) + _FIRST_VERTEX
    outside = face == n_cells
    arc = (outside | outside[twin])[:, None]
    no_vertex = np.array([0, 1])
    columns = np.concatenate(
        [
            he_table[:, :3],
            np.where(arc, no_vertex, ends),
            np.where(arc & ~outside[:, None], ends, no_vertex),
            face[:, None],
        ],
        axis=1,
    )
    columns[outside] = [0, 0, 0, 0, 1, 0, 1, 0]
    columns[outside, 2] = twin[outside]
    first = np.unique(np.where(outside, n_cells, face), return_index=True)[1][:n_cells]
    face_table = np.stack([first, np.zeros_like(first)], axis=1)
    return BoundedTables(vertices, angles, columns.astype(np.int32), face_table.astype(np.int32))


def checked(tables: BoundedTables) -> BoundedTables:
    """The tables as arrays of the right shapes and types."""
    v, angles, he, faces = tables
    v = checked_table("vert_table", v, "finite positions", "(vertices, 2)")
    angles = checked_table("ang_table", angles, "finite angles", "(edges,)")
    he = checked_table("he_table", he, "integers", "(rows, 8)")
    faces = checked_table("face_table", faces, "integers", "(rows, 2)")
    used = he[:, 3:7]
    if used.size and used.max() >= len(v) + _FIRST_VERTEX:
        raise ValueError(
            f"Table `he_table` is broken: vertices must lie in {_FIRST_VERTEX} … "
            f"{len(v) + _FIRST_VERTEX - 1}."
        )
    return BoundedTables(v, angles, he, faces)


def checked_table(name: str, table: Any, content: str, shape: str, remedy: str = "") -> np.ndarray:
    """A table as an array of integers, or of other content. In `shape` a number is the length of an axis."""
    array = np.asarray(table)
    axes = [axis for axis in shape[1:-1].split(",") if axis]
    kinds = "iu" if content == "integers" else "fi"
    fits = array.ndim == len(axes) and array.dtype.kind in kinds and array.size > 0
    if (
        not fits
        or (len(axes) == 2 and array.shape[1] != int(axes[1]))
        or not np.isfinite(array).all()
    ):
        raise ValueError(
            f"Table `{name}` must hold {content}, shape {shape}, but has shape {array.shape} and type "
            f"{array.dtype}.{remedy}"
        )
    return array.astype(int) if kinds == "iu" else array
