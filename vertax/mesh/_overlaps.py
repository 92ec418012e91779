"""Whether a tissue tiles the plane: where its cells overlap, or nearly do."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh._sides import Sides, sides_cross
from vertax.mesh._topology import Topology, take

Carry = TypeVar("Carry")


# If every face is a simple polygon (of arcs) that runs counter-clockwise, and the exterior clockwise, then
# the tissue tiles the plane: by their turning numbers the angles of all faces add up to one full turn for
# each vertex, and no vertex has less, so its three faces surround it once. Nothing has to be compared across
# faces.
class Overlaps(eqx.Module):
    """Where the faces of a tissue overlap; under `jax.vmap` one entry for each of the batch.

    A tissue tiles the plane if each of its cells, and the exterior of a free one, is a simple polygon (of
    straight edges or of arcs), and no cell is inside out.
    """

    crossed: Int[Array, "*batch halfedges"]
    """For each half-edge another one, a side of the same face, that it crosses; itself if there is none."""
    cells: Bool[Array, "*batch cells"]
    """Which cells cross themselves or are inside out."""
    exterior: Bool[Array, "*batch"]
    """Whether the outline of a free tissue crosses itself."""

    @property
    def any(self) -> Bool[Array, "*batch"]:
        """Whether anything overlaps."""
        return jnp.any(self.cells, axis=-1) | self.exterior

    @property
    def sides(self) -> Bool[Array, "*batch halfedges"]:
        """Which half-edges cross another side of the face on their left."""
        return self.crossed != jnp.arange(self.crossed.shape[-1])

    def describe(self) -> str:
        """Where the tissue (of a batch: the first one that does) overlaps, in words; empty if nowhere."""
        bad = np.flatnonzero(np.atleast_1d(self.any))
        if not bad.size:
            return ""
        of_first = lambda x: np.asarray(x).reshape(-1, x.shape[-1])[bad[0]]
        cells, crossed = of_first(self.cells), of_first(self.crossed)
        where = [f"cell {cell}" for cell in np.flatnonzero(cells)[:3]]
        if np.ravel(self.exterior)[bad[0]]:
            where.append("the outline")
        if np.sum(cells) > 3:
            where.append(f"{np.sum(cells)} cells in all")
        sides = np.flatnonzero(crossed != np.arange(crossed.size))
        if sides.size:
            ends = sides[0] // 3, crossed[sides[0]] // 3
            where.append(f"where sides that leave the vertices {ends[0]} and {ends[1]} cross")
        return ", ".join(where)


def find_overlaps(topology: Topology, sides: Sides, areas: Float[Array, " cells"]) -> Overlaps:
    """Compare each side with all others of its face."""
    crossed = crossed_sides(sides, topology.next, _last(topology), few_long=topology.exterior)
    return _overlaps(topology, areas, crossed)


def crossed_sides(
    sides: Sides,
    following: Int[Array, " halfedges"],
    last: Int[Array, " halfedges"],
    *,
    few_long: bool = False,
) -> Int[Array, " halfedges"]:
    """For each side another one of its face that it crosses, or itself.

    **Arguments:**

    - `following`: the next side of the face.
    - `last`: two less than the number of its sides.
    - `few_long`: as for `around`.
    """

    def compare(pair: Pairs, crossed: Array) -> Array:
        return jnp.where(_crosses(pair), pair.other, crossed)

    here = jnp.arange(len(sides), dtype=following.dtype)
    rows = lambda half_edges: take(sides, half_edges)
    return around(rows, following, here, last, compare, here, few_long=few_long)


def overlaps_and_nearest(
    m: Topology,
    sides: Sides,
    areas: Float[Array, " cells"],
    measure: Callable[[Sides, Sides, Array, Array], Float[Array, " halfedges"]],
) -> tuple[Bool[Array, " vertices"], Int[Array, "2 halfedges"], Float[Array, "2 halfedges"]]:
    """The vertices of overlaps; and of each corner the two nearest sides of its face that it does not end.

    Vertices of overlaps are the corners of cells that cross themselves or are inside out, and the ends of the
    sides of the outline that cross.

    **Arguments:**

    - `measure`: how near the starts of sides are to other sides; given also whether each of those is the
        next side, and whether it is the last but one.

    **Returns:** the vertices; the two sides, as half-edges; and how near they are.
    """
    here = _numbers(m)
    before_last = take(m.previous, m.previous)

    def both(pair: Pairs, carry: tuple) -> tuple:
        crossed, first, second, low, high = carry
        after = jnp.broadcast_to(pair.k == 1, pair.here.shape)
        before = pair.other == take(before_last, pair.here)
        paired = pair.other != pair.here
        gap = jnp.where(paired, measure(pair.mine, pair.theirs, after, before), jnp.inf)
        crossed |= sides_cross(pair.mine, pair.theirs, pair.k == 1) & paired
        nearest, nearer = gap < low, gap < high
        second = jnp.where(nearest, first, jnp.where(nearer, pair.other, second))
        high = jnp.where(nearest, low, jnp.where(nearer, gap, high))
        first, low = jnp.where(nearest, pair.other, first), jnp.where(nearest, gap, low)
        return crossed, first, second, low, high

    none, no = jnp.full(here.size, jnp.inf, sides.dtype), jnp.zeros(here.size, bool)
    start = (no, here, here, none, none)
    rows = lambda half_edges: take(sides, half_edges)
    crossed, first, second, low, high = around(
        rows, m.next, here, _last(m), both, start, few_long=m.exterior
    )
    inside_out = ~(areas > 0) & m.alive if m.spare else ~(areas > 0)
    faces = jnp.concatenate([inside_out, jnp.zeros(m.n_faces - m.n_cells, bool)])
    faces = faces.at[m.cell].max(crossed)
    bad = take(faces, m.cell)
    if m.exterior:
        ends = crossed | take(crossed, m.previous)
        bad = jnp.where(m.cell == m.n_cells, ends, bad)
    vertices = functools.reduce(jnp.logical_or, (bad[slot::3] for slot in range(3)))
    return vertices, jnp.stack([first, second]), jnp.stack([low, high])


def _crosses(pair: Pairs) -> Bool[Array, " pairs"]:
    return sides_cross(pair.mine, pair.theirs, pair.k == 1) & (pair.other != pair.here)


def _overlaps(
    m: Topology, areas: Float[Array, " cells"], crossed: Int[Array, " halfedges"]
) -> Overlaps:
    crosses = (crossed != _numbers(m)).astype(jnp.int32)
    faces = jax.ops.segment_max(crosses, m.cell, m.n_faces) > 0
    exterior = faces[m.n_cells] if m.exterior else jnp.array(False)
    inside_out = ~(areas > 0) & m.alive if m.spare else ~(areas > 0)
    return Overlaps(crossed, faces[: m.n_cells] | inside_out, exterior)


def _numbers(topology: Topology) -> Int[Array, " halfedges"]:
    return jnp.arange(topology.n_half_edges, dtype=topology.twin.dtype)


def _last(topology: Topology) -> Int[Array, " halfedges"]:
    return take(_number_of_sides(topology), topology.cell) - 2


def _number_of_sides(topology: Topology) -> Int[Array, " faces"]:
    n_sides = jax.ops.segment_sum(jnp.ones_like(topology.cell), topology.cell, topology.n_faces)
    return n_sides.at[topology.spare_label].set(0) if topology.spare else n_sides


class Pairs(NamedTuple):
    """Some half-edges, and for each the one that comes k sides later in its face, or itself."""

    k: Int[Array, ""]
    here: Int[Array, " pairs"]
    other: Int[Array, " pairs"]
    mine: Sides
    theirs: Sides


def around(
    sides_of: Callable[[Int[Array, " some"]], Sides],
    following: Int[Array, " halfedges"],
    here: Int[Array, " some"],
    last: Int[Array, " some"],
    body: Callable[[Pairs, Carry], Carry],
    start: Carry,
    *,
    few_long: bool = False,
) -> Carry:
    """Walk around faces, all at once: `body` sees each half-edge with the one k sides further.

    k goes from 1 to `last`, which may differ from face to face; half-edges that are through are paired with
    themselves. With two less than the number of sides each corner meets all sides that it does not end.

    **Arguments:**

    - `sides_of`: the sides that half-edges are.
    - `following`: of each half-edge the next one of its face.
    - `here`: from where to walk, half-edges.
    - `last`: how far to go from each.
    - `body`: takes pairs, and the rows of what is carried that belong to them; returns these rows anew.
    - `start`: arrays with a row for each of `here`.
    - `few_long`: whether some faces have far more sides than most, as the exterior has. Then those that
        still have some way to go are walked with by themselves.

    **Returns:** what is carried, at the end.
    """
    n = here.size

    def walk(here: Int[Array, " some"], last: Int[Array, " some"], start: Carry) -> Carry:
        mine = sides_of(here)

        def one(k: Int[Array, ""], carry: tuple) -> tuple:
            other, inner = carry
            other = take(following, other)
            partner = jnp.where(k <= last, other, here)
            return other, body(Pairs(k, here, partner, mine, sides_of(partner)), inner)

        return jax.lax.fori_loop(1, jnp.max(last) + 1, one, (here, start))[1]

    size = min(n, max(64, int(4 * n**0.5)) if few_long else _PIECE)
    if size == n:
        return walk(here, last, start)
    # Those with the longest way come first, so that the others are soon through. (The last piece is filled
    # up with what has no way to go.)
    order = jnp.argsort(-last) if few_long else None
    sort = lambda x: x if order is None else take(x, order)
    filled = lambda x: jnp.append(sort(x), jnp.zeros(-n % size, x.dtype))
    here, last, start = jax.tree.map(filled, (here, last, start))

    def piece(i: Int[Array, ""], carry: Carry) -> Carry:
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, i * size, size)
        put = lambda x, part: jax.lax.dynamic_update_slice_in_dim(x, part, i * size, 0)
        return jax.tree.map(put, carry, walk(cut(here), cut(last), jax.tree.map(cut, carry)))

    end = jax.lax.fori_loop(0, here.size // size, piece, start)
    end = jax.tree.map(lambda x: x[:n], end)
    return end if order is None else jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x), end)


# What is walked with at once: so much stays at hand.
_PIECE = 16384
