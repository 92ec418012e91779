"""Overlaps of cells: sides of a face that cross, and sides that are close to each other."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax._base.indexing import take
from vertax.mesh._sides import Sides, sides_cross
from vertax.mesh._topology import Topology

Carry = TypeVar("Carry")


# If every face is a simple polygon (of arcs) with counter-clockwise orientation, and the exterior one with
# clockwise orientation, then the tissue tiles the plane: by the turning numbers of the faces, the angles of
# all faces sum to 2π per vertex. No vertex has less than 2π, so its three faces surround it exactly once.
# Therefore sides of different faces need not be compared.
class Overlaps(eqx.Module):
    """Overlaps of the faces of a tissue; under `jax.vmap` with a leading batch axis.

    A tissue tiles the plane if each of its cells, and the exterior of a free one, is a simple polygon (of
    straight edges or of arcs), and no cell is inside out (of area ≤ 0).
    """

    crossed: Int[Array, "*batch halfedges"]
    """For each half-edge another one of the same face that it crosses; itself if there is none."""
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
        """List the overlaps as text, of a batch those of the first tissue with overlaps; empty without."""
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
    """Compare each side with all other sides of its face."""
    crossed = crossed_sides(sides, topology.next, _last(topology), few_long=topology.exterior)
    return _overlaps(topology, areas, crossed)


def crossed_sides(
    sides: Sides,
    following: Int[Array, " halfedges"],
    last: Int[Array, " halfedges"],
    *,
    few_long: bool = False,
) -> Int[Array, " halfedges"]:
    """For each side another side of its face that it crosses, or the side itself.

    **Arguments:**

    - `sides`, shape `(sides, 4)` or `(sides, 5)`: start, vector, and with arcs the angle of each side.
    - `following`: for each side, the next side of its face.
    - `last`: for each side, the number of sides of its face minus two.
    - `few_long`: whether a small number of faces, such as the exterior, has many more sides than the others.
    """

    def compare(pair: Pairs, crossed: Array) -> Array:
        return jnp.where(_crosses(pair), pair.other, crossed)

    half_edges = jnp.arange(len(sides), dtype=following.dtype)
    rows = lambda half_edges: take(sides, half_edges)
    return loop_over_side_pairs(
        rows, following, half_edges, last, compare, half_edges, few_long=few_long
    )


def overlaps_and_nearest(
    m: Topology,
    sides: Sides,
    areas: Float[Array, " cells"],
    measure: Callable[[Sides, Sides, Array, Array], Float[Array, " halfedges"]],
) -> tuple[Bool[Array, " vertices"], Int[Array, "2 halfedges"], Float[Array, "2 halfedges"]]:
    """The vertices of overlaps; and for each corner the two nearest sides of its face that do not end at it.

    Vertices of overlaps are the corners of cells that cross themselves or are inside out, and the ends of the
    sides of the outline that cross.

    **Arguments:**

    - `measure`: returns the distance from the start of each side to another side. Its third argument states
        whether the other side is the next one of the face, its fourth whether it is the last but one.

    **Returns:** which vertices belong to overlaps; the two sides, as half-edges; and their distances.
    """
    half_edges = _numbers(m)
    before_last = take(m.previous, m.previous)

    def compare(pair: Pairs, carry: tuple) -> tuple:
        crossed, first, second, low, high = carry
        after = jnp.broadcast_to(pair.k == 1, pair.half_edge.shape)
        before = pair.other == take(before_last, pair.half_edge)
        paired = pair.other != pair.half_edge
        gap = jnp.where(paired, measure(pair.side, pair.other_side, after, before), jnp.inf)
        crossed |= sides_cross(pair.side, pair.other_side, pair.k == 1) & paired
        nearest, nearer = gap < low, gap < high
        second = jnp.where(nearest, first, jnp.where(nearer, pair.other, second))
        high = jnp.where(nearest, low, jnp.where(nearer, gap, high))
        first, low = jnp.where(nearest, pair.other, first), jnp.where(nearest, gap, low)
        return crossed, first, second, low, high

    infinite = jnp.full(half_edges.size, jnp.inf, sides.dtype)
    start = (jnp.zeros(half_edges.size, bool), half_edges, half_edges, infinite, infinite)
    rows = lambda half_edges: take(sides, half_edges)
    crossed, first, second, low, high = loop_over_side_pairs(
        rows, m.next, half_edges, _last(m), compare, start, few_long=m.exterior
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
    crosses = sides_cross(pair.side, pair.other_side, pair.k == 1)
    return crosses & (pair.other != pair.half_edge)


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
    """Half-edges, each with the one that is k sides later in its face, or with itself."""

    k: Int[Array, ""]
    half_edge: Int[Array, " pairs"]
    other: Int[Array, " pairs"]
    side: Sides
    other_side: Sides


def loop_over_side_pairs(
    sides_of: Callable[[Int[Array, " some"]], Sides],
    following: Int[Array, " halfedges"],
    half_edges: Int[Array, " some"],
    last: Int[Array, " some"],
    body: Callable[[Pairs, Carry], Carry],
    start: Carry,
    *,
    few_long: bool = False,
) -> Carry:
    """Loop over k = 1, 2, …: `body` gets each half-edge with the half-edge k sides later in its face.

    k ends at `last`, which may differ between faces; after that a half-edge is paired with itself. If `last`
    is the number of sides minus two, each corner is paired with all sides that do not end at it.

    **Arguments:**

    - `sides_of`: returns the sides of half-edges.
    - `following`: for each half-edge, the next one of its face.
    - `half_edges`: the half-edges to start from.
    - `last`: the largest k of each.
    - `body`: takes pairs and the rows of the carry that belong to them; returns the updated rows.
    - `start`: the initial carry: arrays with a row for each of `half_edges`.
    - `few_long`: whether a small number of faces, such as the exterior, has many more sides than the others.
        Then half-edges are sorted by `last`, so that only the first pieces need many steps.

    **Returns:** the final carry.
    """
    n = half_edges.size

    def walk(half_edges: Int[Array, " some"], last: Int[Array, " some"], start: Carry) -> Carry:
        sides = sides_of(half_edges)

        def step(k: Int[Array, ""], carry: tuple) -> tuple:
            other, inner = carry
            other = take(following, other)
            partner = jnp.where(k <= last, other, half_edges)
            pairs = Pairs(k, half_edges, partner, sides, sides_of(partner))
            return other, body(pairs, inner)

        return jax.lax.fori_loop(1, jnp.max(last) + 1, step, (half_edges, start))[1]

    size = min(n, max(64, int(4 * n**0.5)) if few_long else _PIECE)
    if size == n:
        return walk(half_edges, last, start)
    # Half-edges with the largest `last` come first, so that the other pieces end early. (The last piece is
    # padded with `last` = 0.)
    order = jnp.argsort(-last) if few_long else None
    sort = lambda x: x if order is None else take(x, order)
    pad = lambda x: jnp.append(sort(x), jnp.zeros(-n % size, x.dtype))
    half_edges, last, start = jax.tree.map(pad, (half_edges, last, start))

    def piece(i: Int[Array, ""], carry: Carry) -> Carry:
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, i * size, size)
        put = lambda x, part: jax.lax.dynamic_update_slice_in_dim(x, part, i * size, 0)
        return jax.tree.map(put, carry, walk(cut(half_edges), cut(last), jax.tree.map(cut, carry)))

    end = jax.lax.fori_loop(0, half_edges.size // size, piece, start)
    end = jax.tree.map(lambda x: x[:n], end)
    return end if order is None else jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x), end)


# Number of half-edges in a piece, such that their rows stay in the cache of the CPU.
_PIECE = 16384
