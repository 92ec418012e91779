"""Cells come and go: what changes of the connectivity when one divides, vanishes or fuses.

All of this is for one place at a time, whose half-edge may be traced; `do` says whether anything happens.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vertax.mesh._topology import Topology, clockwise, counter_clockwise, source, take

Index = Int[Array, ""]
Yes = Bool[Array, ""]


class Slot(NamedTuple):
    """Room for one cell more."""

    cell: Index
    vertices: tuple[Index, Index]
    edges: tuple[Index, Index, Index]
    there: Yes
    """Whether there is any; if not the numbers mean nothing."""


def spare_slot(topology: Topology) -> Slot:
    """The first spare slot of each kind."""
    m, dtype = topology, topology.twin.dtype
    none = jnp.zeros((), dtype)
    if not m.spare:
        return Slot(none, (none, none), (none, none, none), jnp.array(False))
    cell, vertex = (jnp.argmin(alive).astype(dtype) for alive in (m.alive, m.alive_vertices))
    first, second, third = (take(m.edge, 3 * vertex + k) for k in range(3))
    other = source(take(m.twin, 3 * vertex))
    return Slot(cell, (vertex, other), (first, second, third), ~jnp.all(m.alive))


def _put(array: Array, do: Yes, *pairs: tuple[Index, Array]) -> Array:
    """Write values at indices, if at all."""
    index = jnp.stack([i for i, _ in pairs])
    values = jnp.stack([jnp.asarray(value, array.dtype) for _, value in pairs])
    return array.at[jnp.where(do, index, array.shape[0])].set(values, mode="drop")


def _with(topology: Topology, **arrays: Array) -> Topology:
    names = tuple(arrays)
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in names], topology, [arrays[name] for name in names]
    )


def insert_vertex(m: Topology, h: Index, vertex: Index, edge: Index, do: Yes) -> Topology:
    """Put a vertex of a spare slot on an edge, and a new edge between it and the end of half-edge `h`.

    Of its half-edges the first goes on to the end of `h`, the third goes back; the second points into the
    cell on the left of `h` and is for the caller to connect.
    """
    ahead, inward, back = (3 * vertex + k for k in range(3))
    t, old = take(m.twin, h), take(m.edge, h)
    # At a corner the cell and the image are those of the corner where `h` begins.
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


def split_cell(m: Topology, first: Index, second: Index, slot: Slot, do: Yes) -> Topology:
    """Divide a cell by an edge between two of its sides, as half-edges with the cell on their left.

    The new vertices of the slot lie on the first and on the second side. What comes after the first and
    before the second becomes the new cell.
    """
    (a, b), (edge_a, edge_b, between) = slot.vertices, slot.edges
    m = insert_vertex(m, first, a, edge_a, do)
    m = insert_vertex(m, second, b, edge_b, do)
    there, back = 3 * a + 1, 3 * b + 1
    m = _with(
        m,
        twin=_put(m.twin, do, (there, back), (back, there)),
        edge=_put(m.edge, do, (there, between), (back, between)),
        half_edge=_put(m.half_edge, do, (between, there)),
    )
    return _with(m, cell=_relabelled(m, 3 * a, slot.cell, do)[0])


def _relabelled(m: Topology, start: Index, label: Index, do: Yes) -> tuple[Array, Array]:
    """The cells of half-edges with one face called otherwise; and which half-edges those are."""

    # The next half-edge around a face is a permutation, so the walk returns to its start. (It also ends if
    # it meets a half-edge again, which a broken topology may have.)
    def one(carry: tuple) -> tuple:
        marked, h, _ = carry
        h = clockwise(take(m.twin, h))
        return marked.at[h].set(True), h, (h != start) & ~take(marked, h)

    marked = jnp.zeros(m.n_half_edges, bool)
    marked, *_ = jax.lax.while_loop(lambda carry: carry[2], one, (marked, start, do))
    return jnp.where(marked, label, m.cell), marked


def _freed(m: Topology, vertices: tuple[Index, Index], edges: tuple, do: Yes) -> Topology:
    """Make two vertices and three edges that nothing holds on to any more a spare slot."""
    one, other = (3 * v for v in vertices)
    here, there = [one + k for k in range(3)], [other, other + 2, other + 1]
    pairs = [*zip(here, there, strict=True), *zip(there, here, strict=True)]
    zero = jnp.zeros(2, m.frame.dtype)
    slots = [*here, *there]
    return _with(
        m,
        twin=_put(m.twin, do, *pairs),
        cell=_put(m.cell, do, *((h, jnp.asarray(m.spare_label)) for h in slots)),
        frame=_put(m.frame, do, *((h, zero) for h in slots)),
        edge=_put(m.edge, do, *zip(slots, [*edges, *edges], strict=True)),
        half_edge=_put(m.half_edge, do, *zip(edges, here, strict=True)),
    )


def collapse_triangle(m: Topology, h: Index, do: Yes) -> Topology:
    """Make a cell of three sides a vertex, that at which the half-edge `h` with it on its left begins.

    Its neighbours lose a side each; none may have less than four.
    """
    sides = [h]
    for _ in range(2):
        sides.append(clockwise(take(m.twin, sides[-1])))
    outward = [clockwise(side) for side in sides]
    ends = [take(m.twin, out) for out in outward]
    kept = [outward[0]]
    for _ in range(2):
        kept.append(counter_clockwise(kept[-1]))
    # Seen from the cell, the corners of a neighbour are one lattice vector away from its own.
    home = take(m.frame, h)
    frames = [
        home + take(m.frame, out) - take(m.frame, side)
        for out, side in zip(outward, sides, strict=True)
    ]
    edges = [take(m.edge, out) for out in outward]
    begins = [
        jnp.where(take(m.half_edge, edge) == out, new, end)
        for edge, out, new, end in zip(edges, outward, kept, ends, strict=True)
    ]
    cells = [take(m.cell, out) for out in outward]
    gone = tuple(take(m.edge, side) for side in sides)
    vertices = source(sides[1]), source(sides[2])
    m = _with(
        m,
        twin=_put(m.twin, do, *zip(kept, ends, strict=True), *zip(ends, kept, strict=True)),
        cell=_put(m.cell, do, *zip(kept, cells, strict=True)),
        frame=_put(m.frame, do, *zip(kept, frames, strict=True)),
        edge=_put(m.edge, do, *zip(kept, edges, strict=True)),
        half_edge=_put(m.half_edge, do, *zip(edges, begins, strict=True)),
    )
    return _freed(m, vertices, gone, do)


def merge_cells(m: Topology, h: Index, do: Yes) -> Topology:
    """Take an edge away: the cell on the left of the half-edge `h` becomes a part of that on its right.

    The other two edges at either end become one. This is what undoes a division.
    """
    t = take(m.twin, h)
    # The absorbed corners are numbered in the frame of the other cell from now on.
    shift = take(m.frame, clockwise(h)) - take(m.frame, h)
    cell, marked = _relabelled(m, h, take(m.cell, t), do)
    m = _with(m, cell=cell, frame=jnp.where(marked[:, None], m.frame + shift, m.frame))
    gone = [take(m.edge, h)]
    for half_edge, outer in ((h, clockwise), (t, counter_clockwise)):
        kept, lost = outer(half_edge), outer(outer(half_edge))
        end, start, edge = take(m.twin, kept), take(m.twin, lost), take(m.edge, kept)
        gone.append(take(m.edge, lost))
        forward = take(m.half_edge, edge) == kept
        m = _with(
            m,
            twin=_put(m.twin, do, (start, end), (end, start)),
            edge=_put(m.edge, do, (start, edge)),
            half_edge=_put(m.half_edge, do, (edge, jnp.where(forward, start, end))),
        )
    return _freed(m, (source(h), source(t)), tuple(gone), do)
