"""The loop of a relaxation: steps of a minimiser, with transitions between them. Not differentiable."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.reductions import any_of
from vertax._base.results import RESULTS
from vertax._base.scales import Scales
from vertax._base.tracing import tree_where, zeros_of
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.precondition._sum import Preconditioner
from vertax.relax._contacts import Contacts, no_contacts
from vertax.relax._feasibility import Feasibility
from vertax.relax._objective import objective, preconditioner_of
from vertax.solvers import AbstractIteration


class SearchState(eqx.Module):
    """The state of a relaxation."""

    tissue: Tissue
    """At the iterate: the last accepted point, made feasible."""
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    iteration: PyTree
    contacts: Contacts | None
    preconditioner: Preconditioner
    """Of steps from the iterate."""
    overlaps: Bool[Array, ""]
    """Whether the tissue overlaps, as it has since the start."""
    counts: Int[Array, "*rules edges"]
    """How often each edge took part in a transition."""
    force: Float[Array, ""]
    num_below: Int[Array, ""]
    """Consecutive steps after which the force is below the tolerance."""
    num_steps: Int[Array, ""]
    reference_value: Float[Array, ""]
    """The energy at the last check of progress; infinite before."""
    num_stalls: Int[Array, ""]
    """Consecutive checks without progress; `max_stalls` at once for a tissue that overlaps."""
    started: Bool[Array, ""]
    finished: Bool[Array, ""]

    @property
    def num_t1(self) -> Int[Array, ""]:
        """Transitions so far."""
        return jnp.sum(self.counts)


class Search(eqx.Module):
    """A relaxation with topology changes, which can stop after any step and continue.

    Each trip of the loop is one evaluation of the objective at the trial point:

    1. Evaluate the trial point, and accept or reject it (`iteration.evaluate`).
    2. Make an accepted point feasible: T1 transitions, contacts, no overlaps (`feasibility`).
    3. If that has changed the point or the contacts, evaluate it anew in the next trip. Otherwise compute the
        next step (`iteration.propose`).

    Progress is checked every `check_every` steps of a minimiser that returns its `value`. The search ends

    - if the tissue overlaps (an overlap at the start that resolves does so within about 20 steps);
    - if `max_stalls` consecutive checks show no progress: the largest force $f$ is above $0.01\\,k \\ell$,
        and the energy has fallen by less than $f \\min(\\ell / 10, f / k)$ since the check before, about the
        gain of a single step without obstacles; or it has fallen by more than $10^8\\,k \\ell^2$.

    **Arguments:**

    - `iteration`: the minimiser.
    - `feasibility`: what an accepted point must be.
    - `scales`: typical sizes, and the largest force at rest.
    - `consecutive_steps`: steps in a row after which the force must be below the tolerance.
    - `contact_range`: of contacts; None to let cells overlap.
    - `max_contacts`: most contacts; None for a default by the size of the tissue.
    - `check_every`: number of steps from one check of progress to the next.
    - `max_stalls`: number of consecutive checks without progress that end the search.
    """

    iteration: AbstractIteration
    feasibility: Feasibility
    scales: Scales
    consecutive_steps: int | Int[Array, ""]
    contact_range: float | Float[Array, ""] | None
    max_contacts: int | None = eqx.field(static=True)
    check_every: int = eqx.field(static=True, default=100)
    max_stalls: int = eqx.field(static=True, default=2)

    def begin(self, tissue: Tissue, energy: AbstractEnergy) -> SearchState:
        """The state before the first step."""
        rule = self.feasibility.transitions
        counts = jnp.zeros(tissue.n_edges, jnp.int32) if rule is None else rule.init(tissue)
        contacts = None
        if self.contact_range is not None:
            contacts = no_contacts(
                self.contact_range, self.scales.length, tissue, self.max_contacts
            )
            contacts = contacts.with_stiffness(self.scales.stiffness)
        args = (tissue, energy, contacts)
        false, zero = jnp.array(False), jnp.array(0)
        return SearchState(
            tissue=tissue,
            origin=tissue.configuration,
            iteration=self.iteration.unevaluated(
                objective, tissue.configuration, args, self.scales
            ),
            contacts=contacts,
            preconditioner=zeros_of(eqx.filter_eval_shape(self._preconditioner, *args)),
            overlaps=false,
            counts=counts,
            force=jnp.full((), jnp.inf, tissue.vertices.dtype),
            num_below=zero,
            num_steps=zero,
            reference_value=jnp.full((), jnp.inf, tissue.vertices.dtype),
            num_stalls=zero,
            started=false,
            finished=false,
        )

    def advance(
        self, state: SearchState, energy: AbstractEnergy, num_steps: int | Int[Array, ""]
    ) -> SearchState:
        """Continue until the tissue is at rest, or after `num_steps` steps in all."""
        # Minimisers may keep functions in their state, which a loop cannot carry.
        arrays, static = eqx.partition(state, eqx.is_array)

        def unfinished(arrays: SearchState) -> Bool[Array, ""]:
            return ~arrays.finished & (arrays.num_steps < num_steps)

        def iterate(arrays: SearchState) -> SearchState:
            return eqx.filter(self._step(eqx.combine(arrays, static), energy), eqx.is_array)

        return eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static)

    def result(self, state: SearchState) -> RESULTS:
        """The result of a search that does not continue."""
        at_rest = state.num_below >= self.consecutive_steps
        result = RESULTS.where(at_rest, RESULTS.successful, RESULTS.nonlinear_max_steps_reached)
        reason = RESULTS.where(state.overlaps, RESULTS.overlap, RESULTS.no_progress)
        result = RESULTS.where(state.num_stalls >= self.max_stalls, reason, result)
        if state.contacts is not None:
            result = RESULTS.where(state.contacts.overflow, RESULTS.too_many_contacts, result)
        finite = jnp.isfinite(state.force) & jnp.all(jnp.isfinite(state.tissue.vertices))
        return RESULTS.where(finite, result, RESULTS.nonfinite)

    def _step(self, state: SearchState, energy: AbstractEnergy) -> SearchState:
        """One trip of the loop."""
        iteration, before, scales = self.iteration, state.tissue, self.scales
        y, minimiser, model, _ = iteration.evaluate(
            objective,
            before.configuration,
            (before, energy, state.contacts),
            scales,
            state.iteration,
        )
        progress, trial = iteration.progress(minimiser), before.with_configuration(y)
        arrives = progress.moved | ~state.started
        start = self.feasibility.start(before, state.contacts, state.counts)
        feasible = self.feasibility(
            start, trial, energy, active=arrives, guarded=~state.overlaps, first=~state.started
        )
        tissue, contacts = feasible.tissue, feasible.contacts
        flipped = any_of(feasible.counts != state.counts)
        changed = flipped | _moved(trial, tissue)
        if contacts is not None and state.contacts is not None:
            changed |= contacts.differ(state.contacts)
        fraction = before.by_row(feasible.fraction)
        minimiser = iteration.moved(minimiser, fraction, flipped, changed, scales)
        below = (progress.force < scales.tolerance) & ~changed
        num_below = jnp.where(below, state.num_below + 1, 0)
        num_below = jnp.where(progress.accepted | changed, num_below, state.num_below)
        overlaps = jnp.where(arrives, any_of(feasible.overlapping), state.overlaps)
        num_steps = state.num_steps + progress.stepped
        at_rest = num_below >= self.consecutive_steps
        value, num_stalls = state.reference_value, state.num_stalls
        if (now := iteration.value(minimiser)) is not None:
            checks = progress.stepped & (num_steps % self.check_every == 0)
            stalls = self._stalls(value - now, progress.force, tissue.n_vertices)
            after = jnp.where(overlaps, self.max_stalls, jnp.where(stalls, num_stalls + 1, 0))
            num_stalls = jnp.where(checks & ~at_rest, after, num_stalls)
            value = jnp.where(checks, now, value)
        finished = at_rest | (num_stalls >= self.max_stalls) | jnp.isnan(progress.force)
        active = progress.accepted & ~changed & ~finished
        preconditioner = self._updated(state.preconditioner, tissue, energy, contacts, active)
        minimiser = iteration.propose(model, scales, minimiser, active, preconditioner)
        return SearchState(
            tissue=tissue,
            origin=tree_where(flipped, tissue.configuration, state.origin),
            iteration=minimiser,
            contacts=contacts,
            preconditioner=preconditioner,
            overlaps=overlaps,
            counts=feasible.counts,
            force=progress.force,
            num_below=num_below,
            num_steps=num_steps,
            reference_value=value,
            num_stalls=num_stalls,
            started=jnp.array(True),
            finished=finished,
        )

    def _stalls(self, gain: Array, force: Array, n_vertices: int) -> Bool[Array, ""]:
        """Whether the energy has fallen by too little for its largest force, or without limit."""
        length, stiffness, unit = self.scales.length, self.scales.stiffness, self.scales.force
        little = gain < force * jnp.minimum(0.1 * length, force / stiffness)
        little &= force > 0.01 * unit
        # (The first gain is infinite.)
        return little | ((gain > n_vertices * unit * length) & jnp.isfinite(gain))

    def _updated(
        self,
        preconditioner: Preconditioner,
        tissue: Tissue,
        energy: AbstractEnergy,
        contacts: Contacts | None,
        active: Bool[Array, ""],
    ) -> Preconditioner:
        """The preconditioner where a step begins; otherwise the last one."""
        if preconditioner.is_diagonal:
            return preconditioner
        arrays, static = eqx.partition(preconditioner, eqx.is_array)
        build = lambda: eqx.filter(self._preconditioner(tissue, energy, contacts), eqx.is_array)
        return eqx.combine(jax.lax.cond(active, build, lambda: arrays), static)

    def _preconditioner(
        self, tissue: Tissue, energy: AbstractEnergy, contacts: Contacts | None
    ) -> Preconditioner:
        """The preconditioner of a step."""
        if not self.iteration.uses_preconditioner:
            return Preconditioner(None, None)
        return preconditioner_of(tissue, energy, contacts)


def _moved(one: Tissue, other: Tissue) -> Bool[Array, ""]:
    """Whether two tissues have different configurations.

    NaN equals NaN: otherwise a search would not end where an energy ignores a coordinate that is NaN.
    """
    differ = lambda a, b: any_of((a != b) & ~(jnp.isnan(a) & jnp.isnan(b)))
    parts = jax.tree.map(differ, one.configuration, other.configuration)
    return functools.reduce(jnp.logical_or, jax.tree.leaves(parts))
