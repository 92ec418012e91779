"""The way to an equilibrium: steps of a minimiser, and transitions between them. Not differentiable."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.solvers._patience import Patient, PatientState
from vertax.transitions import AbstractTransitions


class SearchState(eqx.Module):
    """How far a search has come."""

    tissue: Tissue
    origin: PyTree[Array]
    """The configuration right after the last transition, or the first one."""
    minimiser: PatientState
    counts: Int[Array, " edges"]
    """How often each edge took part in a transition."""
    num_steps: Int[Array, ""]
    finished: Bool[Array, ""]

    @property
    def num_t1(self) -> Int[Array, ""]:
        """Transitions so far."""
        return jnp.sum(self.counts)


class Search(eqx.Module):
    """A relaxation with topology changes, which can stop after any step and go on.

    **Arguments:**

    - `minimiser`: takes the steps and knows when the tissue is at rest.
    - `transitions`: the rule for topology changes, or None.
    - `options`: of the minimiser: typical sizes and the tolerance.
    """

    minimiser: Patient
    transitions: AbstractTransitions | None
    options: dict[str, Array]

    def begin(self, tissue: Tissue, energy: AbstractEnergy) -> SearchState:
        """The state before the first step."""
        rule = self.transitions
        counts = jnp.zeros(0, jnp.int32) if rule is None else rule.init(tissue)
        minimiser = self._restarted(tissue, energy)
        return SearchState(
            tissue, tissue.configuration, minimiser, counts, jnp.array(0), jnp.array(False)
        )

    def advance(
        self, state: SearchState, energy: AbstractEnergy, num_steps: int | Int[Array, ""]
    ) -> SearchState:
        """Go on until the tissue is at rest, or so many steps are done in all."""
        # Minimisers may keep functions in their state, which a loop cannot carry.
        arrays, static = eqx.partition(state, eqx.is_array)

        def unfinished(arrays: SearchState) -> Bool[Array, ""]:
            return ~arrays.finished & (arrays.num_steps < num_steps)

        def iterate(arrays: SearchState) -> SearchState:
            return eqx.filter(self._step(eqx.combine(arrays, static), energy), eqx.is_array)

        return eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static)

    def result(self, state: SearchState) -> optx.RESULTS:
        """The outcome of a search that is not to go on."""
        result = optx.RESULTS.where(
            self.minimiser.at_rest(state.minimiser),
            optx.RESULTS.successful,
            optx.RESULTS.nonlinear_max_steps_reached,
        )
        finite = jnp.isfinite(state.minimiser.force) & jnp.all(jnp.isfinite(state.tissue.vertices))
        return optx.RESULTS.where(finite, result, optx.RESULTS.nonfinite)

    def _step(self, state: SearchState, energy: AbstractEnergy) -> SearchState:
        tissue, counts, minimiser, origin = (
            state.tissue,
            state.counts,
            state.minimiser,
            state.origin,
        )
        flipped = jnp.array(False)
        if self.transitions is not None:
            tissue, counts = self.transitions.sweep(tissue, energy, state.counts)
            flipped = jnp.any(counts != state.counts)
            # What a minimiser remembers of the old topology misleads it in the new one.
            restart = lambda: self._restarted(tissue, energy)
            minimiser = _either(flipped, restart, lambda: state.minimiser, state.minimiser)
            moved = lambda new, old: jnp.where(flipped, new, old)
            origin = jax.tree.map(moved, tissue.configuration, origin)
        at_rest = self.minimiser.at_rest(minimiser) & ~flipped
        finished = at_rest | jnp.isnan(minimiser.force)

        def step() -> tuple[PyTree, PatientState]:
            y, new, _ = self.minimiser.step(
                objective, tissue.configuration, (tissue, energy), self.options, minimiser, _TAGS
            )
            return y, new

        here = (tissue.configuration, minimiser)
        y, minimiser = _either(finished, lambda: here, step, here)
        num_steps = state.num_steps + jnp.where(finished, 0, 1)
        moved = tissue.with_configuration(y)
        return SearchState(moved, origin, minimiser, counts, num_steps, finished)

    def _restarted(self, tissue: Tissue, energy: AbstractEnergy) -> PatientState:
        struct = jax.ShapeDtypeStruct((), tissue.vertices.dtype)
        args = (tissue, energy)
        return self.minimiser.init(
            objective, tissue.configuration, args, self.options, struct, None, _TAGS
        )


_TAGS: frozenset[object] = frozenset()


def objective(
    configuration: PyTree[Array], args: tuple[Tissue, AbstractEnergy]
) -> tuple[Float[Array, ""], None]:
    """The energy of a configuration, as Optimistix wants it."""
    tissue, energy = args
    return energy(tissue.with_configuration(configuration)), None


def _either(condition: Bool[Array, ""], yes: Any, no: Any, like: Any) -> Any:
    """`jax.lax.cond` of two functions whose results may hold more than arrays; that stays as in `like`."""
    arrays_of = lambda function: lambda: eqx.filter(function(), eqx.is_array)
    arrays = jax.lax.cond(condition, arrays_of(yes), arrays_of(no))
    return eqx.combine(arrays, eqx.partition(like, eqx.is_array)[1])
