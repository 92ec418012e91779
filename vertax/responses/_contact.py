"""Contact: what keeps the sides of a face from passing through one another."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.extremes import lesser
from vertax._base.reciprocal import reciprocal
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
from vertax.mesh._topology import Topology, take
from vertax.responses._local import FLOOR, Looks, along_each, barrier, local_blocks, local_sum
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
    - `kinds`: whether one side of each pair comes after the other, or before it; and whether they are two.
    - `slack`: how far the vertices may move until something else may come into range.
    - `upheld`: short edges that would turn inside out.
    - `looks`: of those first; then for each pair at the corner, and at the start and the end of the side.
    """

    distance: Float[Array, ""]
    slope: Float[Array, ""]
    strength: Float[Array, ""]
    pairs: Int[Array, "contacts 2"]
    kinds: Bool[Array, "3 contacts"]
    slack: Float[Array, ""]
    upheld: Upheld
    looks: Looks

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of the barrier."""
        # Most tissues are free of contacts most of the time, and arcs take thirty times as long with them.
        # Large ones are never free of them, but have few.
        n = len(self.pairs)
        some, energies = [self], [Contacts._energy]
        if tissue.arcs is None:
            some = [self.first(n // 16), self] if n >= _MANY else [self]
            # Without contacts derivatives would still hand on arrays of zeros: many of them, or long ones.
            energies = [Contacts._energy_of_few, jax.checkpoint(Contacts._energy)]
        enough = sum(jnp.sum(self.kinds[2]) > len(few.pairs) for few in some[:-1])
        enough = jnp.where(jnp.any(self.kinds[2]) | self.upheld.any, 1 + enough, 0)
        if tissue.arcs is None:
            # What is near need not be in range; if nothing is, all derivatives vanish as well.
            there = jax.lax.stop_gradient(tissue)
            none = lambda: jnp.array(False)
            in_range = [lambda few=few: few._in_range(there) for few in some]
            enough = jnp.where(jax.lax.switch(enough, [none, *in_range]), enough, 0)
        energies = [
            lambda few=few, energy=energy: energy(few, tissue)
            for few, energy in zip(some, energies, strict=False)
        ]
        return jax.lax.switch(enough, [lambda: jnp.zeros((), tissue.vertices.dtype), *energies])

    def first(self, size: int) -> Contacts:
        """The first ones alone."""
        few = self.pairs[:size], self.kinds[:, :size], self.looks[: self._n_looks + 3 * size]
        return eqx.tree_at(lambda c: (c.pairs, c.kinds, c.looks), self, few)

    def between(self, topology: Topology, pairs: Int[Array, "contacts 2"]) -> Contacts:
        """The same of other pairs, in a topology."""
        m, (corner, side) = topology, pairs.T
        end = take(m.next, side)
        after, before = take(m.next, corner) == side, take(m.next, end) == corner
        kinds = jnp.stack([after, before, corner != side])
        looks = Looks.of(m, jnp.stack([corner, side, end], axis=-1)).flat()
        looks = self.looks[: self._n_looks].then(looks)
        return eqx.tree_at(lambda c: (c.pairs, c.kinds, c.looks), self, (pairs, kinds, looks))

    def holding(self, topology: Topology, upheld: Upheld) -> Contacts:
        """The same with other upheld edges, in a topology."""
        looks = upheld.looks(topology).flat().then(self.looks[self._n_looks :])
        return eqx.tree_at(lambda c: (c.upheld, c.looks), self, (upheld, looks))

    @property
    def _n_looks(self) -> int:
        return 6 * len(self.upheld.edges)

    def differ(self, other: Contacts) -> Bool[Array, ""]:
        """Whether these are others."""
        return jnp.any(self.pairs != other.pairs) | jnp.any(self.upheld.edges != other.upheld.edges)

    def _energy(self, tissue: Tissue) -> Float[Array, ""]:
        one, other = map(tissue.sides_of, self.pairs.T)
        of_upheld = self.first(0)._energy_of_few(tissue)
        return self.strength * jnp.sum(self._heights(one, other)) + of_upheld

    def _energy_of_few(self, tissue: Tissue) -> Float[Array, ""]:
        return local_sum(_heights, self, self._places(tissue))

    def _places(self, tissue: Tissue) -> Float[Array, "some 4"]:
        # (At once: the derivative of every look at the vertices is as long as all of them.)
        there = self.looks.at(tissue)
        of_upheld, of_pairs = there[: self._n_looks], there[self._n_looks :]
        of_upheld = self.upheld.places(of_upheld.reshape(-1, 6, 2))
        return jnp.concatenate([of_upheld, _pair_places(of_pairs)])

    def _in_range(self, tissue: Tissue) -> Bool[Array, ""]:
        looks = self.looks[self._n_looks :]
        near = self._near(*_as_sides(_pair_places(looks.at(tissue))))
        return jnp.any(jnp.stack([near < 1 for near, _ in near])) | self.upheld.any

    def resistance(self, tissue: Tissue) -> Symmetric:
        """How the barrier resists where one vertex moves alone, nowhere softer than nothing.

        For a preconditioner: of straight sides, and of so many contacts as there mostly are.
        """
        few = self.first(max(_FEW, len(self.pairs) // 16))
        looks = few.looks[few._n_looks :]
        rows = local_blocks(Contacts._pair_heights, few, _pair_places(looks.at(tissue)))
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
            return nothing.at[looks.vertices].add(jnp.stack(blocks, axis=-1).reshape(-1))

        blocks = (block.positive for block in (corner, start, chord))
        return Symmetric(*(gathered(*each) for each in zip(*blocks, strict=True)))

    def _pair_heights(self, places: Float[Array, "some 4"]) -> Float[Array, " some"]:
        return self.strength * self._heights(*_as_sides(places))

    def _heights(self, one: Sides, other: Sides) -> Float[Array, " some"]:
        """How high the barrier is for each pair, in units of its strength."""
        heights = jnp.zeros(len(one), one.dtype)
        for near, squared in self._near(one, other):
            # (What is far may be infinitely so.)
            heights += squared * barrier(jnp.where(near < 1, near, 1))
        return heights

    def _near(
        self, one: Sides, other: Sides
    ) -> list[tuple[Float[Array, " some"], Float[Array, " some"]]]:
        """How near the corners and sides of pairs are, see `_nearness`; those of no pair are far away."""
        nearness = self._nearness(one, other, *self.kinds[:2])
        return [(jnp.where(self.kinds[2], near, 1), squared) for near, squared in nearness]

    def _nearness(
        self, one: Sides, other: Sides, after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> list[tuple[Float[Array, " n"], Float[Array, " n"]]]:
        """Squared distance over squared range, and the squared range, times how much that counts.

        The distance is that of the start of one side from the other; of arcs also that between the two, or
        the angle if one follows on the other.
        """
        apart = jnp.broadcast_to(reciprocal(self.distance**2), after.shape)

        def inverse_square(arm: Float[Array, " n"], where: Bool[Array, " n"]) -> Float[Array, " n"]:
            """Of the range, where a side is next to another one with a squared distance to its end."""
            where &= arm > 0
            return apart + jnp.where(where, reciprocal(self.slope**2 * jnp.where(where, arm, 1)), 0)

        first = one[:, :2] - other[:, :2]
        last = first - other[:, 2:4]
        inverse = inverse_square(lesser(dot(first, first), dot(last, last)), after | before)
        squared = reciprocal(inverse)
        if one.shape[-1] == 4:
            return [(squared_distance_to_segment(one[:, :2], other) * inverse, squared)]
        circles = circle_of(one), circle_of(other)
        near = [(squared_distance_to_arc(one[:, :2], other, circles[1]) * inverse, squared)]
        sine, cosine = wedge(one, circles)
        acute = after & (cosine > 0) & (sine > 0)
        arms = dot(one[:, 2:4], one[:, 2:4]), dot(other[:, 2:4], other[:, 2:4])
        # (The corner's other side is next to the one before. This one is not, and may come near anywhere.)
        inverse = inverse_square(lesser(*arms), after)
        angle = jnp.where(acute, (sine / self.slope) ** 2, jnp.inf)
        gap, weight = bulge_gap(one, other, circles, self.distance)
        far = jnp.isinf(gap)
        gap = jnp.where(far, jnp.inf, jnp.where(far, 1, gap) ** 2 * inverse)
        weight = reciprocal(inverse) * jnp.where(after, 1, weight)
        near.append((jnp.where(after, angle, gap), weight))
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
        found = eqx.tree_at(lambda c: c.slack, self.between(tissue.topology, pairs), slack)
        return found, overlaps.vertices(tissue.topology)

    def crushed(
        self, before: Tissue, tissue: Tissue, known: Bool[Array, " vertices"]
    ) -> Bool[Array, " vertices"]:
        """The vertices of contacts that a step has brought behind the crest of their barrier.

        That is said only of contacts between `known` vertices, which are what they were before.
        """
        sides = [map(there.sides_of, self.pairs.T) for there in (before, tissue)]
        steps = zip(*(self._near(*both) for both in sides), strict=True)
        worse = [(new < _CREST) & (new < old) for (old, _), (new, _) in steps]
        ends = self.looks.vertices[self._n_looks :].reshape(-1, 3)
        behind = functools.reduce(jnp.logical_or, worse) & jnp.all(take(known, ends), axis=-1)
        return jnp.zeros(tissue.n_vertices, bool).at[ends].max(behind[:, None])

    def relief(
        self,
        before: Tissue,
        tissue: Tissue,
        known: Bool[Array, " vertices"],
        free: Bool[Array, " vertices"],
    ) -> Float[Array, "vertices 2"]:
        """How free vertices may leave contacts (of straight sides) that a step has brought deep into range.

        A barrier pushes harder there than all else together, and steps would come out of it one by one.
        """
        looks = self.looks[self._n_looks :]
        ends = looks.vertices.reshape(-1, 3)
        places_of = lambda tissue: _pair_places(looks.at(tissue))
        near = lambda places: self._near(*_as_sides(places))[0][0]
        old = jnp.where(jnp.all(take(known, ends), axis=-1), near(places_of(before)), jnp.inf)

        def hits(moves: Float[Array, "vertices 2"]) -> tuple[Array, Array]:
            places = places_of(tissue.with_vertices(tissue.vertices + moves))
            new = near(places)
            # (What is pressed as deep as that by large forces stays there.)
            return places, (new > 0) & (new < jnp.minimum(_DEEP, 0.5 * old))

        def unfinished(last: tuple) -> Bool[Array, ""]:
            i, _, (_, hit) = last
            return (i < _ROUNDS) & jnp.any(hit)

        def further(last: tuple) -> tuple:
            i, moves, (places, hit) = last
            distance = lambda places: jnp.sqrt(jnp.where(hit, near(places), 1))
            corner, end = jnp.split(along_each(distance, places), 2)
            ways = jnp.stack([corner, -corner - end, end])
            squared = jnp.sum(ways**2, axis=(0, 1))
            ways *= (_SHALLOW - distance(places)) / jnp.where(squared > 0, squared, 1)
            size = jnp.sqrt(jnp.sum(ways**2, axis=1))
            share = jnp.minimum(1, self.distance / jnp.where(size > 0, size, 1))
            # (Two corners that are near each other are in contact by all their sides, and go further.)
            ways = jnp.where(hit, ways * share[:, None], 0)
            moves = moves.at[ends.T].add(jnp.moveaxis(ways, 1, -1))
            moves = jnp.where(free[:, None], moves, 0)
            return i + 1, moves, hits(moves)

        nothing = jnp.zeros_like(tissue.vertices)
        start = jnp.array(0), nothing, hits(nothing)
        return jax.lax.while_loop(unfinished, further, start)[1]

    def moved(self, before: Tissue, tissue: Tissue) -> tuple[Contacts, Bool[Array, ""]]:
        """The contacts after vertices moved, if there are none, and whether that is certain."""
        steps = jnp.sum((tissue.vertices - before.vertices) ** 2, axis=-1)
        slack = self.slack - jnp.sqrt(jnp.max(steps))
        # (Arcs bend as well, and their angles are not those of the chords.)
        straight = jnp.array(tissue.arcs is None)
        clear = straight & (slack > 0) & _angles_are_open(tissue, _MARGIN * self.slope)
        none = 0 * self.pairs, jnp.zeros_like(self.kinds), slack
        return eqx.tree_at(lambda c: (c.pairs, c.kinds, c.slack), self, none), clear


def _pair_places(there: Float[Array, "looks 2"]) -> Float[Array, "some 4"]:
    there = there.reshape(-1, 3, 2)
    corner, start, end = (there[:, k] for k in range(3))
    return jnp.concatenate([corner - start, end - start], axis=-1)


def _as_sides(places: Float[Array, "some 4"]) -> tuple[Sides, Sides]:
    # A corner and a straight side have four degrees of freedom: where the corner is from the start of the
    # side, and the chord.
    first, chord = places[:, :2], places[:, 2:]
    zero = jnp.zeros_like(first)
    return jnp.concatenate([first, zero], axis=-1), jnp.concatenate([zero, chord], axis=-1)


def _heights(contacts: Contacts, places: Float[Array, "some 4"]) -> Float[Array, " some"]:
    """The energies of upheld edges, and then of pairs."""
    n = len(contacts.upheld.edges)
    of_upheld = contacts.upheld.heights(places[:n])
    return jnp.concatenate([of_upheld, contacts._pair_heights(places[n:])])


# So many contacts count for a preconditioner at least.
_FEW = 64
# From so many places for a contact on it pays to look whether a few would do.
_MANY = 1000
# The barrier pushes hardest at FLOOR (squared distance over range) and not at all at 0. Only too long a step
# leads nearer than this.
_CREST = 4 * FLOOR
# What has come deeper than this at once is taken back to so many ranges, in so many rounds: who leaves one
# contact may come into another one.
_DEEP = 0.5
_SHALLOW = 0.9
_ROUNDS = 4
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
    upheld = Upheld.none(tissue, jnp.minimum(reach, REACH) * length, strength * slope * length)
    n, some = tissue.n_vertices, 3 * tissue.n_vertices + 6 * len(upheld.edges)
    index = tissue.topology.twin.dtype
    none = jnp.zeros((n, 2), index), jnp.zeros((3, n), bool)
    looks = Looks(jnp.zeros(some, index), jnp.zeros((some, 2), tissue.topology.frame.dtype))
    return Contacts(reach * length, slope, strength, *none, jnp.zeros_like(length), upheld, looks)


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
