"""Contact: barriers between corners and sides of a cell, and barriers of short edges against inversion."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.indexing import take
from vertax._base.plane import dot
from vertax._base.reductions import any_of, count_true, indices_of_true
from vertax.mesh import Tissue, Topology
from vertax.mesh._overlaps import overlaps_and_nearest
from vertax.precondition._edge_blocks import Symmetric
from vertax.relax._arc_barrier import ArcBarrier
from vertax.relax._barrier import GatherPlan, barrier_energy
from vertax.relax._inversion_barrier import REACH, InversionBarrier
from vertax.relax._pair_barrier import AbstractPairBarrier, SegmentBarrier


class Contacts(eqx.Module):
    """The barriers of a tissue in one topology.

    **Arguments:**

    - `pairs`: of corners and sides that are near.
    - `sides`: their half-edges: the corner is the source of the first one. The same twice after the last one.
    - `plan`: where their positions are: the corner, the start and the end of the side.
    - `inversion`: short edges that would turn inside out.
    - `inversion_plan`: where their positions are.
    - `overflow`: whether more pairs are near than there are rows.
    """

    pairs: AbstractPairBarrier
    sides: Int[Array, "2 pairs"]
    plan: GatherPlan
    inversion: InversionBarrier
    inversion_plan: GatherPlan
    overflow: Bool[Array, ""]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of the barriers."""

        def energy() -> Float[Array, ""]:
            straight = tissue.arcs is None
            of_sides = lambda: jnp.stack([tissue.sides_of(sides) for sides in self.sides])
            positions = self.plan.positions(tissue) if straight else of_sides()
            return barrier_energy(self.pairs, positions) + self._inversion_energy(tissue)

        # (Most of the time there are no contacts, and the barriers take longer than the energy.)
        return jax.lax.cond(self.some, energy, lambda: jnp.zeros((), tissue.vertices.dtype))

    @property
    def capacity(self) -> int:
        """The number of rows for pairs."""
        return self.sides.shape[-1]

    @property
    def some(self) -> Bool[Array, ""]:
        """Whether any barrier is on."""
        return any_of(self.pairs.valid) | self.inversion.any

    def _inversion_energy(self, tissue: Tissue) -> Float[Array, ""]:
        return barrier_energy(self.inversion, self.inversion_plan.positions(tissue))

    def differ(self, other: Contacts) -> Bool[Array, ""]:
        """Whether the rows differ."""
        changed = any_of(self.sides != other.sides)
        return changed | any_of(self.inversion.edges != other.inversion.edges)

    def resistance(self, tissue: Tissue) -> Symmetric:
        """The diagonal blocks of the Hessian of the pairs, without negative eigenvalues.

        For a preconditioner, and for straight sides.
        """
        vectors = self.pairs.vectors(self.plan.positions(tissue))
        rows = self.pairs.expansion(vectors).block
        # The corner moves the first vector, the end of the side moves its chord, the start moves both.
        part = lambda i, j: Symmetric(rows[i, j], rows[i, j + 1], rows[i + 1, j + 1])
        corner, chord = part(0, 0), part(2, 2)
        start = Symmetric(
            *(
                rows[i, j] + rows[i, j + 2] + rows[i + 2, j] + rows[i + 2, j + 2]
                for i, j in ((0, 0), (0, 1), (1, 1))
            )
        )
        nothing = jnp.zeros(tissue.n_vertices, tissue.vertices.dtype)
        gathered = lambda *blocks: nothing.at[self.plan.vertices].add(jnp.stack(blocks))
        blocks = (block.positive for block in (corner, start, chord))
        return Symmetric(*(gathered(*each) for each in zip(*blocks, strict=True)))

    def with_stiffness(self, stiffness: Float[Array, ""]) -> Contacts:
        """The same contacts in a material of another stiffness."""
        # (The strength is a power of 16: otherwise it would depend on the parameters of the energy.)
        step = 16.0 ** jnp.round(jnp.log(stiffness) / jnp.log(16.0))
        strength = step / self.pairs.slope
        force = step * self.pairs.distance / self.pairs.slope * SLOPE
        return eqx.tree_at(lambda c: (c.pairs.strength, c.inversion.force), self, (strength, force))

    def updated(
        self,
        point: Tissue,
        tissue: Tissue,
        unflipped: Bool[Array, "*rules edges"],
        holds: Bool[Array, ""],
    ) -> tuple[Contacts, Bool[Array, " vertices"]]:
        """The contacts of a tissue, and the vertices of cells that overlap.

        **Arguments:**

        - `point`: the tissue before transitions.
        - `tissue`: after them.
        - `unflipped`: which edges have not taken part.
        - `holds`: whether an edge that turned around although its barrier is on counts as an overlap.
        """
        contacts, overlapping = self.updated_pairs(tissue)
        m = tissue.topology
        start, end = m.edge_vertices.T
        both = jnp.concatenate([point.vertices, tissue.vertices], axis=1)
        offset = tissue.boundary.translation(take(m.offset, m.half_edge))
        vectors = take(both, end) - take(both, start) + jnp.concatenate([offset, offset], axis=1)
        old, new = vectors[:, :2], vectors[:, 2:]
        # An edge that has turned without a flip is inverted.
        turned = (dot(old, new) < 0) & jnp.all(unflipped.reshape(-1, tissue.n_edges), axis=0)
        # If its barrier is on, the step has jumped across it.
        jumped = turned & self.inversion.held & holds
        overlapping = overlapping.at[jnp.stack([start, end])].max(jumped)
        inversion = self.inversion.updated(turned, dot(new, new))
        return contacts.holding(m, inversion), overlapping

    def holding(self, topology: Topology, inversion: InversionBarrier) -> Contacts:
        """A copy with the barrier on for other edges, in a topology."""
        new = (inversion, inversion.plan(topology))
        return eqx.tree_at(lambda c: (c.inversion, c.inversion_plan), self, new)

    def updated_pairs(self, tissue: Tissue) -> tuple[Contacts, Bool[Array, " vertices"]]:
        """The contacts with the pairs of a tissue, and the vertices of cells that overlap."""
        m, size, measure = tissue.topology, self.capacity, self.pairs.nearness
        overlapping, nearest, gaps = overlaps_and_nearest(m, tissue.sides, tissue.areas, measure)
        near = (gaps < _MARGIN**2).reshape(-1)
        # (A slice of its results would make XLA sort instead.)
        which, valid = indices_of_true(near, size)
        overflow = count_true(near) > size
        which = which.astype(m.twin.dtype)
        corner = jax.lax.rem(which, jnp.asarray(m.n_half_edges, which.dtype))
        sides = jnp.where(valid, jnp.stack([corner, take(nearest.reshape(-1), which)]), 0)
        corner, side = sides
        end = take(m.next, side)
        after, before = take(m.next, corner) == side, take(m.next, end) == corner
        plan = GatherPlan.of(m, jnp.stack([corner, side, end]))
        pairs = eqx.tree_at(
            lambda p: (p.after, p.before, p.valid), self.pairs, (after, before, valid)
        )
        new = (pairs, sides, plan, overflow)
        contacts = eqx.tree_at(lambda c: (c.pairs, c.sides, c.plan, c.overflow), self, new)
        return contacts, overlapping


# Pairs are listed up to this distance, in units of the range: a step may bring them into range.
_MARGIN = 2
SLOPE = 5.0
"""Between adjacent sides the range is this number times `contact_range` times the distance from their common
end: the two ranges agree at a fifth of a cell from the end."""


def no_contacts(
    reach: float | Float[Array, ""],
    length: Float[Array, ""],
    tissue: Tissue,
    capacity: int | None = None,
) -> Contacts:
    """No contacts, in a material of stiffness 1.

    **Arguments:**

    - `reach`: the range in units of the size of a cell.
    - `length`: the size of a cell.
    - `tissue`: for which tissue.
    - `capacity`: the number of rows; by default the number of vertices, at least 64; above 2000 vertices 2000
        or, if that is more, a quarter of the number of vertices.
    """
    reach = jnp.maximum(jnp.asarray(reach, length.dtype), 1e-9)
    slope = SLOPE * reach
    inversion = InversionBarrier.empty(tissue, jnp.minimum(reach, REACH) * length, length)
    n = (
        max(64, min(tissue.n_vertices, 2000), tissue.n_vertices // 4)
        if capacity is None
        else capacity
    )
    topology = tissue.topology
    false, sides = jnp.zeros(n, bool), jnp.zeros((2, n), topology.twin.dtype)
    barrier = SegmentBarrier if tissue.arcs is None else ArcBarrier
    return Contacts(
        barrier(reach * length, slope, 1 / slope, false, false, false),
        sides,
        GatherPlan.empty(topology, (3, n)),
        inversion,
        GatherPlan.empty(topology, (6, len(inversion.edges))),
        jnp.array(False),
    )
