"""Contact: what keeps the sides of a face from passing through one another."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue
from vertax.mesh._overlaps import overlaps_and_nearest
from vertax.mesh._sides import (
    Sides,
    bulge_gap,
    circle_of,
    cross,
    dot,
    squared_distance_to_arc,
    squared_distance_to_segment,
    wedge,
)
from vertax.mesh._topology import source, take
from vertax.responses._local import FLOOR, local_blocks, local_sum
from vertax.responses._upheld import REACH, Upheld
from vertax.solvers._edge_blocks import Symmetric

# A face comes to overlap itself where a corner reaches a side that it does not end. A barrier holds it off
# (Li et al. 2020, doi:10.1145/3386569.3392425), with s = (D/d)² for the distance D and a range d:
#
#     -d² (1 - s)² ln s     if s < 1, otherwise 0:   twice differentiable, and infinite at s = 0.
#
# (With s + FLOOR in the logarithm it ends at a finite height, which no force in a tissue climbs: an edge that
# shrinks to nothing may point anywhere, along another side as well, and an infinite curvature there would
# hide all others.)
#
# Corners that share a short edge are near each other and not in contact. So for a side next to one of the
# corner's own the range is a share of the distance r to their common end: what counts there is the angle.
SLOPE = 5.0
"""That share over the range in cells: both are the same at a fifth of a cell from the end."""


class Contacts(eqx.Module):
    """The barrier between corners and sides that are near, in one topology.

    **Arguments:**

    - `distance`: the range, a length.
    - `slope`: the range over the distance to the common end, between sides that are next to each other.
    - `strength`: energy per length squared.
    - `pairs`: half-edges whose source is near another side of their face, and that side; the same twice
        after the last one.
    - `slack`: how far the vertices may move until something else may come into range.
    - `upheld`: short edges that would turn inside out.
    """

    distance: Float[Array, ""]
    slope: Float[Array, ""]
    strength: Float[Array, ""]
    pairs: Int[Array, "contacts 2"]
    slack: Float[Array, ""]
    upheld: Upheld

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of the barrier."""
        nothing = lambda: jnp.zeros((), tissue.vertices.dtype)
        # Most tissues are free of contacts most of the time, and arcs take thirty times as long with them.
        # Large ones are never free of them, but have few.
        sizes = [len(self.pairs)]
        if len(self.pairs) >= _MANY and tissue.arcs is None:
            sizes.insert(0, len(self.pairs) // 16)
        count = jnp.sum(self.pairs[:, 0] != self.pairs[:, 1])
        enough = sum(count > size for size in (0, *sizes[:-1]))
        energies = [Contacts._energy for _ in sizes]
        if tissue.arcs is None:
            # What is near need not be in range; if nothing is, all derivatives vanish as well.
            there = jax.lax.stop_gradient(tissue)
            none = lambda: jnp.array(False)
            some = [lambda size=size: self._in_range(there, self.pairs[:size]) for size in sizes]
            enough = jnp.where(jax.lax.switch(enough, [none, *some]), enough, 0)
            # Without contacts derivatives would still hand on arrays of zeros: many of them, or long ones.
            energies = [Contacts._energy_of_few, jax.checkpoint(Contacts._energy)]
        enough = jnp.maximum(enough, jnp.any(self.upheld.edges < tissue.n_edges))
        some = [
            lambda size=size, energy=energy: (
                energy(self, tissue, self.pairs[:size]) + self.upheld(tissue)
            )
            for size, energy in zip(sizes, energies, strict=False)
        ]
        return jax.lax.switch(enough, [nothing, *some])

    def differ(self, other: Contacts) -> Bool[Array, ""]:
        """Whether these are others."""
        return jnp.any(self.pairs != other.pairs) | jnp.any(self.upheld.edges != other.upheld.edges)

    def _energy(self, tissue: Tissue, pairs: Int[Array, "some 2"]) -> Float[Array, ""]:
        corner, side = pairs.T
        one, other = tissue.sides_of(corner), tissue.sides_of(side)
        return self.strength * jnp.sum(self._heights(_kinds(tissue, pairs), one, other))

    def _energy_of_few(self, tissue: Tissue, pairs: Int[Array, "some 2"]) -> Float[Array, ""]:
        _, places = self._places(tissue, pairs)
        return local_sum(_energies, (self, _kinds(tissue, pairs)), places)

    def resistance(self, tissue: Tissue) -> Symmetric:
        """How the barrier resists where one vertex moves alone, nowhere softer than nothing.

        For a preconditioner: of straight sides, and of so many contacts as there mostly are.
        """
        pairs = self.pairs[: max(_FEW, len(self.pairs) // 16)]
        ends, places = self._places(tissue, pairs)
        kinds = _kinds(tissue, pairs)
        rows = local_blocks(_energies, (self, kinds), places)
        # The corner moves the first vector, the end of the side its chord, and its start both.
        part = lambda i, j: Symmetric(rows[i][j], rows[i][j + 1], rows[i + 1][j + 1])
        corner, chord = part(0, 0), part(2, 2)
        start = Symmetric(
            *(
                rows[i][j] + rows[i][j + 2] + rows[i + 2][j] + rows[i + 2][j + 2]
                for i, j in ((0, 0), (0, 1), (1, 1))
            )
        )
        nothing = jnp.zeros(tissue.n_vertices, tissue.vertices.dtype)

        def gathered(*blocks: Float[Array, " some"]) -> Float[Array, " vertices"]:
            return nothing.at[source(ends)].add(jnp.stack(blocks))

        blocks = (block.positive for block in (corner, start, chord))
        return Symmetric(*(gathered(*each) for each in zip(*blocks, strict=True)))

    def _places(
        self, tissue: Tissue, pairs: Int[Array, "some 2"]
    ) -> tuple[Int[Array, "3 some"], Float[Array, "some 4"]]:
        """The half-edges that begin at corners, and at the ends of sides; and where those are."""
        corner, side = pairs.T
        # (At once: the derivative of every look at the vertices is as long as all of them.)
        ends = jnp.stack([corner, side, take(tissue.topology.next, side)])
        corner, start, end = tissue.corners_of(ends)
        return ends, jnp.concatenate([corner - start, end - start], axis=-1)

    def _in_range(self, tissue: Tissue, pairs: Int[Array, "some 2"]) -> Bool[Array, ""]:
        return jnp.any(jnp.stack([near < 1 for near, _ in self._between(tissue, pairs)]))

    def _between(
        self, tissue: Tissue, pairs: Int[Array, "some 2"]
    ) -> list[tuple[Float[Array, " some"], Float[Array, " some"]]]:
        """How near the corners and sides of pairs are, see `_nearness`; those of no pair are far away."""
        corner, side = pairs.T
        after, before, apart = _kinds(tissue, pairs)
        nearness = self._nearness(tissue.sides_of(corner), tissue.sides_of(side), after, before)
        return [(jnp.where(apart, near, 1), squared) for near, squared in nearness]

    def _heights(
        self, kinds: Bool[Array, "3 some"], one: Sides, other: Sides
    ) -> Float[Array, " some"]:
        """How high the barrier is for each pair, in units of its strength."""
        after, before, apart = kinds
        heights = jnp.zeros(len(one), one.dtype)
        for near, squared in self._nearness(one, other, after, before):
            near = jnp.where(apart & (near < 1), near, 1)
            heights -= squared * (1 - near) ** 2 * jnp.log((near + FLOOR) / (1 + FLOOR))
        return heights

    def _nearness(
        self, one: Sides, other: Sides, after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> list[tuple[Float[Array, " n"], Float[Array, " n"]]]:
        """Squared distance over squared range, and the squared range, times how much that counts.

        The distance is that of the start of one side from the other; of arcs also that between the two, or
        the angle if one follows on the other.
        """
        range_ = jnp.broadcast_to(self.distance**2, after.shape)

        def limited(arm: Float[Array, " n"], where: Bool[Array, " n"]) -> Float[Array, " n"]:
            short = self.slope**2 * arm
            short = range_ * short / (range_ + short)
            return jnp.where(where, jnp.where(short > 0, short, 1), range_)

        first = one[:, :2] - other[:, :2]
        last = first - other[:, 2:4]
        limit = limited(jnp.minimum(dot(first, first), dot(last, last)), after | before)
        if one.shape[-1] == 4:
            return [(squared_distance_to_segment(one[:, :2], other) / limit, limit)]
        circles = circle_of(one), circle_of(other)
        near = [(squared_distance_to_arc(one[:, :2], other, circles[1]) / limit, limit)]
        sine, cosine = wedge(one, circles)
        acute = after & (cosine > 0) & (sine > 0)
        arms = dot(one[:, 2:4], one[:, 2:4]), dot(other[:, 2:4], other[:, 2:4])
        # (The corner's other side is next to the one before. This one is not, and may come near anywhere.)
        limit = limited(jnp.minimum(*arms), after)
        angle = jnp.where(acute, (sine / self.slope) ** 2, jnp.inf)
        gap, weight = bulge_gap(one, other, circles, self.distance)
        far = jnp.isinf(gap)
        gap = jnp.where(far, jnp.inf, jnp.where(far, 1, gap) ** 2 / limit)
        near.append((jnp.where(after, angle, gap), limit * jnp.where(after, 1, weight)))
        return near

    def found(self, tissue: Tissue) -> tuple[Contacts, Bool[Array, " vertices"]]:
        """The contacts in a tissue, and the vertices of what overlaps."""

        def measure(one: Sides, other: Sides, after: Array, before: Array) -> Array:
            near = [near for near, _ in self._nearness(one, other, after, before)]
            return near[0] if len(near) == 1 else jnp.minimum(*near)

        overlaps, sides, near, least = overlaps_and_nearest(
            tissue.topology, tissue.sides, tissue.areas, measure
        )
        near = near < _MARGIN**2
        corner, rank = jnp.nonzero(near, size=len(self.pairs), fill_value=0)
        pairs = jnp.stack([corner.astype(sides.dtype), sides[corner, rank]], axis=-1)
        # (`nonzero` fills up with the first one, which may be a pair.)
        there = jnp.arange(len(pairs)) < jnp.sum(near)
        pairs = jnp.where(there[:, None], pairs, 0)
        slack = 0.5 * (jnp.sqrt(least) - _MARGIN) * self.distance
        return eqx.tree_at(lambda c: (c.pairs, c.slack), self, (pairs, slack)), overlaps.vertices(
            tissue.topology
        )

    def crushed(
        self, before: Tissue, tissue: Tissue, known: Bool[Array, " vertices"]
    ) -> Bool[Array, " vertices"]:
        """The vertices of contacts that a step has brought behind the crest of their barrier.

        That is said only of contacts between `known` vertices, which are what they were before.
        """
        corner, side = self.pairs[:, 0], self.pairs[:, 1]
        steps = zip(
            self._between(before, self.pairs), self._between(tissue, self.pairs), strict=True
        )
        worse = [(new < _CREST) & (new < old) for (old, _), (new, _) in steps]
        ends = source(jnp.stack([corner, side, take(tissue.topology.next, side)]))
        behind = functools.reduce(jnp.logical_or, worse) & jnp.all(take(known, ends), axis=0)
        return jnp.zeros(tissue.n_vertices, bool).at[ends].max(behind)

    def moved(self, before: Tissue, tissue: Tissue) -> tuple[Contacts, Bool[Array, ""]]:
        """The contacts after vertices moved, if there are none, and whether that is certain."""
        steps = jnp.sum((tissue.vertices - before.vertices) ** 2, axis=-1)
        slack = self.slack - jnp.sqrt(jnp.max(steps))
        # (Arcs bend as well, and their angles are not those of the chords.)
        straight = jnp.array(tissue.arcs is None)
        clear = straight & (slack > 0) & _angles_are_open(tissue, _MARGIN * self.slope)
        return eqx.tree_at(lambda c: (c.pairs, c.slack), self, (0 * self.pairs, slack)), clear


def _kinds(tissue: Tissue, pairs: Int[Array, "some 2"]) -> Bool[Array, "3 some"]:
    """Whether one side of each pair comes after the other, or before it; and whether they are two."""
    following = tissue.topology.next
    corner, side = pairs.T
    after = take(following, corner) == side
    before = take(following, take(following, side)) == corner
    return jnp.stack([after, before, corner != side])


# A corner and a straight side have four degrees of freedom: where the corner is from the start of the side,
# and the chord.
def _energies(
    args: tuple[Contacts, Bool[Array, "3 some"]], places: Float[Array, "some 4"]
) -> Float[Array, " some"]:
    contacts, kinds = args
    first, chord = places[:, :2], places[:, 2:]
    zero = jnp.zeros_like(first)
    one, other = jnp.concatenate([first, zero], axis=-1), jnp.concatenate([zero, chord], axis=-1)
    return contacts.strength * contacts._heights(kinds, one, other)


# So many contacts count for a preconditioner at least.
_FEW = 64
# From so many places for a contact on it pays to look whether a few would do.
_MANY = 1000
# The barrier pushes hardest at FLOOR (squared distance over range) and not at all at 0. Only too long a step
# leads nearer than this.
_CREST = 4 * FLOOR
# What is less than so many ranges away may come into range in the next step.
_MARGIN = 2


def no_contacts(
    reach: float | Float[Array, ""], options: dict[str, Array], tissue: Tissue
) -> Contacts:
    """Contacts that are not found yet.

    **Arguments:**

    - `reach`: the range in units of the size of a cell.
    - `options`: of a minimiser: typical sizes.
    """
    length, stiffness = options["length_scale"], options["stiffness"]
    reach = jnp.maximum(jnp.asarray(reach, length.dtype), 1e-9)
    slope = SLOPE * reach
    # The barrier must not depend on the parameters of the energy, not even through its strength: that would
    # be one more derivative. So it is a power of 16.
    strength = 16.0 ** jnp.round(jnp.log(stiffness) / jnp.log(16.0)) / slope
    nothing = jnp.zeros((tissue.n_vertices, 2), tissue.topology.twin.dtype)
    slack = jnp.zeros_like(length)
    upheld = Upheld.none(tissue, jnp.minimum(reach, REACH) * length, strength * slope * length)
    return Contacts(reach * length, slope, strength, nothing, slack, upheld)


def _angles_are_open(tissue: Tissue, least: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether edges leave all vertices in order, at angles whose sine is not below a limit."""
    m = tissue.topology
    forward = take(tissue.edge_vectors, m.edge)
    u = jnp.where(m.forward[:, None], forward, -forward).reshape(-1, 3, 2)
    v = jnp.roll(u, -1, axis=1)
    sine, cosine, squared = cross(u, v), dot(u, v), dot(u, u)
    narrow = (cosine > 0) & (sine**2 < least**2 * squared * jnp.roll(squared, -1, axis=1))
    # In order at least two of the three angles are less than π.
    ordered = jnp.sum(sine > 0, axis=1) >= 2
    if m.spare:
        ordered, narrow = ordered | ~m.alive_vertices, narrow & m.alive_vertices[:, None]
    return ~jnp.any(narrow) & jnp.all(ordered)
