"""The neighbourhoods of edges, and the tissue after some edges flip."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.arcs import length_factor
from vertax._base.half_edges import source
from vertax._base.indexing import take
from vertax._base.plane import cross, dot
from vertax.mesh import Tissue
from vertax.mesh._sides import Sides
from vertax.mesh._topology import edge_neighbourhood
from vertax.transitions._euler_operators import flip_edges


class EdgeFrames(eqx.Module):
    """The neighbourhoods of edges: cells, lengths, and directions before and after a T1 transition.

    **Arguments:**

    - `tissue`: the tissue.
    """

    start: Int[Array, " rows"]
    end: Int[Array, " rows"]
    cells: Int[Array, "rows 4"]  # left, right, at the start, at the end
    edges: Int[Array, "rows 5"]  # the edge itself and its four neighbours, see `edge_neighbourhood`
    vector: Float[Array, "rows 2"]
    neighbours: tuple[Sides, Sides, Sides, Sides]
    angle: Float[Array, " rows"]
    stretch: Float[Array, " rows"]  # length / distance of the ends
    length: Float[Array, " rows"]
    along: Float[Array, "rows 2"]
    across: Float[Array, "rows 2"]
    inside_out: Bool[Array, " rows"]
    free: Bool[Array, " rows"]  # neither end is pinned
    can_flip: Bool[Array, " rows"]

    def __init__(self, tissue: Tissue):
        m = tissue.topology
        h = m.half_edge
        t, a, b, c, d = edge_neighbourhood(m)
        self.start, self.end = source(h), source(t)
        self.cells = take(m.cell, jnp.stack([h, t, a, c], axis=-1))
        self.edges = take(m.edge, jnp.stack([h, a, b, c, d], axis=-1))
        # (One gather for all.)
        n = h.size
        sides = tissue.sides_of(jnp.concatenate([h, t, a, b, c, d]))
        forward_side, twin_side, p, q, r, s = (sides[k * n : (k + 1) * n] for k in range(6))
        self.neighbours = (p, q, r, s)
        self.vector = forward = forward_side[:, 2:4]
        chord = jnp.sqrt(dot(forward, forward))
        self.angle, self.stretch = _angles(forward_side), _stretches(forward_side)
        self.length = chord * self.stretch
        axis = edge_axis(forward, *(side[:, 2:4] for side in self.neighbours))
        upright = dot(axis, forward) >= 0
        direction = jnp.where((chord > 0)[:, None], forward, axis)
        direction = jnp.where(upright[:, None], direction, -direction)
        norm = jnp.sqrt(dot(direction, direction))[:, None]
        self.along = direction / jnp.where(norm > 0, norm, 1)
        # A flipped half-edge turns clockwise, see `flip_edges`.
        self.across = jnp.stack([self.along[:, 1], -self.along[:, 0]], axis=-1)
        disordered = _disordered(forward_side, p, q) & _disordered(twin_side, r, s)
        self.inside_out = disordered & ~upright
        left, right, at_start, at_end = (self.cells[:, k] for k in range(4))
        spare = jnp.min(_spare_sides(tissue, self.edges[:, 0], self.cells[:, :2]), axis=-1)
        losses = jnp.where(left == right, 2, 1)
        self.can_flip = (spare >= losses) & (at_start != at_end) & (self.start != self.end)
        self.free = jnp.ones_like(upright)
        if tissue.held is not None:
            self.free = ~take(tissue.held, self.start) & ~take(tissue.held, self.end)
        self.can_flip &= self.free

    def place(
        self,
        tissue: Tissue,
        which: Bool[Array, " rows"],
        direction: Float[Array, "rows 2"],
        length: Float[Array, " rows"],
    ) -> Tissue:
        """Move the ends of the marked edges to a direction and length; the midpoints stay."""
        half = self._half(which, direction, length)
        vertices = tissue.vertices.at[self.start].add(-half).at[self.end].add(half)
        return tissue.with_vertices(vertices)

    def flip(self, tissue: Tissue, which: Bool[Array, " rows"]) -> Tissue:
        """Flip the marked edges in the topology; arcs become straight."""
        number = self.edges[:, 0]
        marked = jnp.zeros(tissue.n_edges, bool).at[number].max(which)
        if tissue.angles is not None:
            tissue = tissue.with_angles(jnp.where(marked, 0, tissue.angles))
        return tissue.with_topology(flip_edges(tissue.topology, marked))

    def changed(
        self,
        tissue: Tissue,
        flips: Bool[Array, " rows"],
        turns: Bool[Array, " rows"],
        length: Float[Array, " rows"],
    ) -> Tissue:
        """The tissue with some edges flipped and others turned to `along`, with a given length."""
        direction = jnp.where(flips[:, None], self.across, self.along)
        chord = jnp.where(flips, length, length / self.stretch)
        return self.flip(self.place(tissue, flips | turns, direction, chord), flips)

    def _half(
        self,
        which: Bool[Array, " rows"],
        direction: Float[Array, "rows 2"],
        length: Float[Array, " rows"],
    ) -> Float[Array, "rows 2"]:
        return jnp.where(which[:, None], 0.5 * (direction * length[:, None] - self.vector), 0)


def edge_axis(
    vector: Float[Array, "rows 2"],
    a: Float[Array, "rows 2"],
    b: Float[Array, "rows 2"],
    c: Float[Array, "rows 2"],
    d: Float[Array, "rows 2"],
) -> Float[Array, "rows 2"]:
    """Direction of edges from the far ends of their neighbours (not normalised).

    It does not depend on the vector of the edge itself, which may be 0 or inverted for a short edge.

    **Arguments:**

    - `vector`: vectors of the edges.
    - `a`, `b`, `c`, `d`: vectors of their neighbours, away from the edge, see `edge_neighbourhood`.
    """
    return c + d - a - b + 2 * vector


def _angles(sides: Sides) -> Float[Array, " sides"]:
    return sides[:, 4] if sides.shape[-1] > 4 else jnp.zeros_like(sides[:, 0])


def _stretches(sides: Sides) -> Float[Array, " sides"]:
    return length_factor(sides[:, 4]) if sides.shape[-1] > 4 else jnp.ones_like(sides[:, 0])


def _disordered(first: Sides, second: Sides, third: Sides) -> Bool[Array, " sides"]:
    """Whether three sides that leave one vertex are not in counter-clockwise order."""
    # They are in order if at least two of their consecutive cross products are positive. If an edge passes
    # through length 0, the order is inverted at both ends.
    p, q, r = (_leaving(side) for side in (first, second, third))
    backwards = [(cross(u, v) < 0).astype(jnp.int32) for u, v in ((p, q), (q, r), (r, p))]
    return sum(backwards, start=jnp.array(0)) >= 2


def _leaving(sides: Sides) -> Float[Array, "sides 2"]:
    """Tangents of sides at their start."""
    chord = sides[:, 2:4]
    if sides.shape[-1] == 4:
        return chord
    sine, cosine = jnp.sin(sides[:, 4:]), jnp.cos(sides[:, 4:])
    return cosine * chord + sine * jnp.stack([chord[:, 1], -chord[:, 0]], axis=-1)


def _spare_sides(
    tissue: Tissue, edges: Int[Array, " rows"], cells: Int[Array, "rows 2"]
) -> Int[Array, "rows 2"]:
    """Number of sides that the cells left and right of each edge can lose, if the edge leaves them."""
    m = tissue.topology
    face_sums = lambda values: jax.ops.segment_sum(values, m.cell, m.n_faces)
    sides = take(face_sums(jnp.ones_like(m.cell)), cells)
    if not m.exterior or tissue.angles is None:
        return sides - 3
    # A cell may have two sides if one of them is an arc on the outline, other than the edge that leaves it;
    # the exterior may have two arcs.
    arcs = take(face_sums(take(m.on_outline, m.edge).astype(m.cell.dtype)), cells)
    return sides - jnp.where(arcs > take(m.on_outline, edges)[:, None], 2, 3)
