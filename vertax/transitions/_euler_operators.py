"""Operators of the mesh: flip edges, split a cell, collapse a triangle, merge two cells.

The last three (Euler operators) change one place of the mesh; its half-edge may be traced. If the boolean
`do` is False the topology is unchanged.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vertax._base.half_edges import clockwise, counter_clockwise, source
from vertax._base.indexing import take
from vertax.mesh import Topology

Index = Int[Array, ""]
Condition = Bool[Array, ""]


class Slot(NamedTuple):
    """A spare slot: the numbers for one new cell."""

    cell: Index
    vertices: tuple[Index, Index]
    edges: tuple[Index, Index, Index]
    available: Condition
    """Whether there is a spare slot; otherwise the numbers are undefined."""


def spare_slot(topology: Topology) -> Slot:
    """The first spare slot."""
    m, dtype = topology, topology.twin.dtype
    zero = jnp.zeros((), dtype)
    if not m.spare:
        return Slot(zero, (zero, zero), (zero, zero, zero), jnp.array(False))
    cell, vertex = (jnp.argmin(alive).astype(dtype) for alive in (m.alive, m.alive_vertices))
    first, second, third = (take(m.edge, 3 * vertex + k) for k in range(3))
    other = source(take(m.twin, 3 * vertex))
    return Slot(cell, (vertex, other), (first, second, third), ~jnp.all(m.alive))


def _put(array: Array, do: Condition, *pairs: tuple[Index, Array]) -> Array:
    """Write values at indices if `do`."""
    index = jnp.stack([i for i, _ in pairs])
    values = jnp.stack([jnp.asarray(value, array.dtype) for _, value in pairs])
    return array.at[jnp.where(do, index, array.shape[0])].set(values, mode="drop")


def _with(topology: Topology, **arrays: Array) -> Topology:
    names = tuple(arrays)
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in names], topology, [arrays[name] for name in names]
    )


def insert_vertex(m: Topology, h: Index, vertex: Index, edge: Index, do: Condition) -> Topology:
    """Split the edge of half-edge `h` by a vertex of a spare slot.

    A new edge joins the vertex and the end of `h`. The first half-edge of the vertex leads to the end of `h`,
    the third to its start; the second points into the cell on the left of `h` and is not connected yet.
    """
    ahead, inward, back = (3 * vertex + k for k in range(3))
    t, old = take(m.twin, h), take(m.edge, h)
    # The corner of the right cell at the start of `h` has this cell and image.
    behind = clockwise(h)
    forward = take(m.half_edge, old) == h
    return _with(
        m,
        twin=_put(m.twin, do, (h, back), (back, h), (ahead, t), (t, ahead)),
        cell=_put(
            m.cell,
            do,
            (ahead, take(m.cell, h)),
            (inward, take(m.cell, h)),
            (back, take(m.cell, t)),
        ),
        frame=_put(
            m.frame,
            do,
            (ahead, take(m.frame, h)),
            (inward, take(m.frame, h)),
            (back, take(m.frame, behind)),
        ),
        edge=_put(m.edge, do, (back, old), (ahead, edge), (t, edge)),
        half_edge=_put(
            m.half_edge,
            do,
            (old, jnp.where(forward, h, back)),
            (edge, jnp.where(forward, ahead, t)),
        ),
    )


def split_cell(m: Topology, first: Index, second: Index, slot: Slot, do: Condition) -> Topology:
    """Split a cell by an edge between two of its sides, given as half-edges with the cell on their left.

    The new vertices of the slot are on the first and the second side. The part of the cell after the first
    and before the second side becomes the new cell.
    """
    (a, b), (edge_a, edge_b, between) = slot.vertices, slot.edges
    m = insert_vertex(m, first, a, edge_a, do)
    m = insert_vertex(m, second, b, edge_b, do)
    h, t = 3 * a + 1, 3 * b + 1  # the half-edges of the new edge
    m = _with(
        m,
        twin=_put(m.twin, do, (h, t), (t, h)),
        edge=_put(m.edge, do, (h, between), (t, between)),
        half_edge=_put(m.half_edge, do, (between, h)),
    )
    return _with(m, cell=_relabelled(m, 3 * a, slot.cell, do)[0])


def _relabelled(m: Topology, start: Index, label: Index, do: Condition) -> tuple[Array, Array]:
    """The array `cell` with a new label for the face of `start`; and the mask of its half-edges."""

    # `next` is a permutation, so the walk around the face returns to its start. (In a broken topology it ends
    # at the first half-edge that was visited before.)
    def step(carry: tuple) -> tuple:
        marked, h, _ = carry
        h = clockwise(take(m.twin, h))
        return marked.at[h].set(True), h, (h != start) & ~take(marked, h)

    marked = jnp.zeros(m.n_half_edges, bool)
    marked, *_ = jax.lax.while_loop(lambda carry: carry[2], step, (marked, start, do))
    return jnp.where(marked, label, m.cell), marked


def _freed(m: Topology, vertices: tuple[Index, Index], edges: tuple, do: Condition) -> Topology:
    """Turn two vertices and three edges that are no longer connected into a spare slot."""
    first, second = (3 * v for v in vertices)
    outward, twins = [first + k for k in range(3)], [second, second + 2, second + 1]
    pairs = [*zip(outward, twins, strict=True), *zip(twins, outward, strict=True)]
    zero = jnp.zeros(2, m.frame.dtype)
    half_edges = [*outward, *twins]
    return _with(
        m,
        twin=_put(m.twin, do, *pairs),
        cell=_put(m.cell, do, *((h, jnp.asarray(m.spare_label)) for h in half_edges)),
        frame=_put(m.frame, do, *((h, zero) for h in half_edges)),
        edge=_put(m.edge, do, *zip(half_edges, [*edges, *edges], strict=True)),
        half_edge=_put(m.half_edge, do, *zip(edges, outward, strict=True)),
    )


def collapse_triangle(m: Topology, h: Index, do: Condition) -> Topology:
    """Collapse a cell with three sides to a vertex: the source of `h`, which has the cell on its left.

    Each neighbour loses one side and must have at least four.
    """
    sides = [h]
    for _ in range(2):
        sides.append(clockwise(take(m.twin, sides[-1])))
    outward = [clockwise(side) for side in sides]
    ends = [take(m.twin, out) for out in outward]
    kept = [outward[0]]
    for _ in range(2):
        kept.append(counter_clockwise(kept[-1]))
    # The frame of a neighbour differs from that of the cell by one lattice vector.
    frame = take(m.frame, h)
    frames = [
        frame + take(m.frame, out) - take(m.frame, side)
        for out, side in zip(outward, sides, strict=True)
    ]
    edges = [take(m.edge, out) for out in outward]
    half_edge = [
        jnp.where(take(m.half_edge, edge) == out, new, end)
        for edge, out, new, end in zip(edges, outward, kept, ends, strict=True)
    ]
    cells = [take(m.cell, out) for out in outward]
    removed = tuple(take(m.edge, side) for side in sides)
    vertices = source(sides[1]), source(sides[2])
    m = _with(
        m,
        twin=_put(m.twin, do, *zip(kept, ends, strict=True), *zip(ends, kept, strict=True)),
        cell=_put(m.cell, do, *zip(kept, cells, strict=True)),
        frame=_put(m.frame, do, *zip(kept, frames, strict=True)),
        edge=_put(m.edge, do, *zip(kept, edges, strict=True)),
        half_edge=_put(m.half_edge, do, *zip(edges, half_edge, strict=True)),
    )
    return _freed(m, vertices, removed, do)


def merge_cells(m: Topology, h: Index, do: Condition) -> Topology:
    """Remove an edge: the cell on the left of the half-edge `h` becomes part of the cell on its right.

    The other two edges at each end become one. This is the inverse of `split_cell`.
    """
    t = take(m.twin, h)
    # Convert the corners of the absorbed cell to the frame of the other cell.
    shift = take(m.frame, clockwise(h)) - take(m.frame, h)
    cell, marked = _relabelled(m, h, take(m.cell, t), do)
    m = _with(m, cell=cell, frame=jnp.where(marked[:, None], m.frame + shift, m.frame))
    removed = [take(m.edge, h)]
    for half_edge, outer in ((h, clockwise), (t, counter_clockwise)):
        kept, lost = outer(half_edge), outer(outer(half_edge))
        end, start, edge = take(m.twin, kept), take(m.twin, lost), take(m.edge, kept)
        removed.append(take(m.edge, lost))
        forward = take(m.half_edge, edge) == kept
        m = _with(
            m,
            twin=_put(m.twin, do, (start, end), (end, start)),
            edge=_put(m.edge, do, (start, edge)),
            half_edge=_put(m.half_edge, do, (edge, jnp.where(forward, start, end))),
        )
    return _freed(m, (source(h), source(t)), tuple(removed), do)


def flip_edges(topology: Topology, flip: Bool[Array, " edges"]) -> Topology:
    """Flip the marked edges (the topological part of a T1 transition).

    A flipped half-edge turns clockwise by 90°: the cells at the ends of the edge become the cells on its
    sides. Two marked edges must not share a cell (except the exterior). Vertices do not move.
    """
    # At h = v -> w, with t its twin, the four other half-edges counter-clockwise are a, b (at v) and
    # c, d (at w). In the picture h points east; V, L, W, R are the cells around it.
    #
    #       a     L     d                     b    L    a
    #        \         /          roll           \     /
    #     V   v --h-- w   W      ======>       V    v    W
    #        /         \                            |h
    #       b     R     c                           w
    #                                             /   \
    #                                            c  R  d
    #
    # The data of a (twin, cell, edge) move to b, b to c, c to d and d to a. `roll` is that permutation of
    # half-edges and `unroll` its inverse. The relabelled mesh is twin' = roll ∘ twin ∘ unroll, which is an
    # involution even if two of the four are twins.
    #
    # Each half-edge computes whether it flips, or which of its two neighbours around the vertex does: the
    # half-edge after a flipped one is an a or a c, the one before it a b or a d.
    twin, frame, h = topology.twin, topology.frame, topology.half_edge
    half_edges = jnp.arange(topology.n_half_edges, dtype=h.dtype)
    left, right = counter_clockwise(half_edges), clockwise(half_edges)
    flips = take(flip, topology.edge)
    follows, leads = take(flips, right), take(flips, left)
    beside = lambda neighbour, turn: turn(take(twin, neighbour))
    roll = jnp.where(leads, beside(left, counter_clockwise), half_edges)
    roll = jnp.where(follows, left, roll)
    unroll = jnp.where(follows, beside(right, clockwise), half_edges)
    unroll = jnp.where(leads, right, unroll)
    ahead = counter_clockwise(twin)
    cell = take(topology.cell, jnp.where(flips, ahead, unroll))
    # Corners: v remains a corner of L and V and becomes one of W; w remains one of R and W and becomes one
    # of V. The frame of a new corner is that of the other end minus the offset of the flipped edge.
    step = (take(frame, clockwise(twin)) - frame) * flips[:, None]
    frame = (
        take(frame, jnp.where(flips, ahead, jnp.where(follows | leads, right, half_edges))) - step
    )
    twin, half_edge = take(roll, take(twin, unroll)), take(roll, h)
    if topology.exterior:  # it must be on the right of edges
        outside = take(cell, half_edge) == topology.n_cells
        half_edge = jnp.where(outside, take(twin, half_edge), half_edge)
    return eqx.tree_at(
        lambda m: (m.twin, m.cell, m.frame, m.edge, m.half_edge),
        topology,
        (
            twin,
            cell,
            frame,
            take(topology.edge, unroll),
            half_edge,
        ),
    )
