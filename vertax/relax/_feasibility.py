"""Feasibility of a trial point: T1 transitions, contacts, and no overlaps."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.indexing import take
from vertax._base.reductions import any_of
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.relax._contacts import Contacts
from vertax.transitions import AbstractTransitions


class Feasible(eqx.Module):
    """A tissue after transitions in which cells do not overlap."""

    tissue: Tissue
    contacts: Contacts | None
    counts: Int[Array, "*rules edges"]
    """How often each edge took part in a transition."""
    fraction: Float[Array, " vertices"]
    """Which fraction of the step each vertex has taken."""
    allowed: Bool[Array, " edges"]
    """Which edges may flip."""
    overlapping: Bool[Array, " vertices"]
    num_attempts: Int[Array, ""]


class Feasibility(eqx.Module):
    """Makes a trial point feasible.

    1. Apply T1 transitions at the trial point, and compute the contacts.
    2. If cells overlap near edges that have flipped, these edges do not flip. Try again.
    3. If cells overlap elsewhere, shorten the step of their vertices by `shortening`. Try again. After
       `max_shortenings` times freeze these vertices; then a neighbourhood that grows with each attempt; all
       other vertices take the full step. At the last attempt all vertices are frozen.
    4. If cells overlap even then, reject the step. Before the first step they overlap in the initial tissue:
       accept it, without flips.

    **Arguments:**

    - `transitions`: the rule for topology changes, or None.
    - `max_attempts`: most attempts; then the step is rejected.
    - `max_shortenings`: after how often vertices of overlapping cells are frozen.
    - `shortening`: factor of a step that made cells overlap.
    """

    transitions: AbstractTransitions | None
    max_attempts: int = eqx.field(static=True, default=12)
    max_shortenings: int = eqx.field(static=True, default=4)
    shortening: float = eqx.field(static=True, default=0.25)

    def __call__(
        self,
        before: Feasible,
        trial: Tissue,
        energy: AbstractEnergy,
        *,
        active: Bool[Array, ""],
        guarded: Bool[Array, ""],
        first: Bool[Array, ""],
    ) -> Feasible:
        """The feasible tissue next to a trial point.

        **Arguments:**

        - `before`: where the step begins.
        - `trial`: the trial point.
        - `energy`: which transitions are to lower.
        - `active`: whether to do anything; otherwise the result is the trial point.
        - `guarded`: whether to avoid overlaps.
        - `first`: whether the trial point is the initial tissue.
        """
        if self.transitions is None and before.contacts is None:
            return eqx.tree_at(lambda f: f.tissue, before, trial)
        start, static = eqx.partition(eqx.tree_at(lambda f: f.tissue, before, trial), eqx.is_array)

        def unfinished(arrays: Feasible) -> Bool[Array, ""]:
            more = arrays.num_attempts < self.max_attempts
            again = guarded & any_of(arrays.overlapping) & more
            return ((arrays.num_attempts == 0) & active) | again

        def iterate(arrays: Feasible) -> Feasible:
            last = eqx.combine(arrays, static)
            return eqx.filter(self._attempt(before, trial, energy, last), eqx.is_array)

        end = jax.lax.while_loop(unfinished, iterate, start)
        stays = eqx.tree_at(
            lambda f: f.fraction, eqx.filter(before, eqx.is_array), jnp.zeros_like(end.fraction)
        )
        # (A selection would be a kernel for each array.)
        rejected = guarded & any_of(end.overlapping) & ~first
        return eqx.combine(jax.lax.cond(rejected, lambda: stays, lambda: end), static)

    def start(self, tissue: Tissue, contacts: Contacts | None, counts: Array) -> Feasible:
        """A tissue before any attempt."""
        dtype = tissue.vertices.dtype
        return Feasible(
            tissue,
            contacts,
            counts,
            fraction=jnp.ones(tissue.n_vertices, dtype),
            allowed=jnp.ones(tissue.n_edges, bool),
            overlapping=jnp.zeros(tissue.n_vertices, bool),
            num_attempts=jnp.array(0),
        )

    def _attempt(
        self, before: Feasible, trial: Tissue, energy: AbstractEnergy, last: Feasible
    ) -> Feasible:
        """One attempt, without the flips or with shorter steps where the last one made cells overlap."""
        fraction, allowed = self._reduced(before, last)
        point = interpolated(before.tissue, trial, fraction)
        tissue, counts = point, before.counts
        if self.transitions is not None:
            tissue, counts = self.transitions.sweep(point, energy, counts, allowed)
        contacts, overlapping = before.contacts, last.overlapping
        if contacts is not None:
            unflipped, holds = counts == before.counts, last.num_attempts < self.max_shortenings
            contacts, overlapping = contacts.updated(point, tissue, unflipped, holds)
        return Feasible(
            tissue,
            contacts,
            counts,
            fraction,
            allowed,
            overlapping,
            last.num_attempts + 1,
        )

    def _reduced(
        self, before: Feasible, last: Feasible
    ) -> tuple[Float[Array, " vertices"], Bool[Array, " edges"]]:
        """The fractions of the next attempt, and which edges may flip in it."""
        if last.contacts is None:
            return last.fraction, last.allowed
        near = dilated(last.tissue, last.overlapping)
        crowded = _flipped(before, last) & _at_ends(last.tissue, near) & last.allowed
        # (A shorter step would also prevent the flip, but it ends where the energy is higher.)
        too_far = last.overlapping & ~any_of(crowded)
        shorter = self.shortening * last.fraction
        shorter = jnp.where(shorter > 2 * self.shortening**self.max_shortenings, shorter, 0)
        fraction = jnp.where(too_far, shorter, last.fraction)
        frozen = dilated(before.tissue, last.overlapping | (fraction == 0))
        frozen &= any_of(too_far & (last.fraction == 0))
        frozen |= last.num_attempts == self.max_attempts - 1
        allowed = last.allowed & ~crowded & ~_at_ends(before.tissue, frozen)
        return jnp.where(frozen, 0, fraction), allowed


def interpolated(one: Tissue, other: Tissue, fraction: Float[Array, " vertices"]) -> Tissue:
    """One tissue with each vertex moved a fraction of the way to its place in the other."""

    def partway(a: Array, b: Array, rows: Array) -> Array:
        rows = rows.reshape(rows.shape + (1,) * (a.ndim - 1))
        return jnp.where(rows < 1, a + rows * (b - a), b)

    y = jax.tree.map(partway, one.configuration, other.configuration, one.by_row(fraction))
    return one.with_configuration(y)


def dilated(tissue: Tissue, vertices: Bool[Array, " vertices"]) -> Bool[Array, " vertices"]:
    """The corners of all faces that have one of these corners."""
    m = tissue.topology
    faces = jnp.zeros(m.n_faces, bool).at[m.cell].max(jnp.repeat(vertices, 3))
    corners = take(faces, m.cell)
    # (The exterior has corners everywhere.)
    if m.n_faces > m.n_cells:
        corners &= m.cell < m.n_cells
    return vertices | corners[::3] | corners[1::3] | corners[2::3]


def _flipped(before: Feasible, after: Feasible) -> Bool[Array, " edges"]:
    """Which edges have taken part in a transition."""
    differ = (before.counts != after.counts).reshape(-1, before.tissue.n_edges)
    return functools.reduce(jnp.logical_or, list(differ))


def _at_ends(tissue: Tissue, vertices: Bool[Array, " vertices"]) -> Bool[Array, " edges"]:
    """Which edges have one of these ends."""
    ends = take(vertices, tissue.topology.edge_vertices)
    return ends[:, 0] | ends[:, 1]
