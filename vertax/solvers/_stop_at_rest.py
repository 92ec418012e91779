"""Termination of a relaxation by its largest force."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.scales import Scales
from vertax.solvers._solver import AbstractSolver


class StopAtRestState(eqx.Module):
    """State of a `StopAtRest`."""

    inner: PyTree
    force: Float[Array, ""]
    num_below: Int[Array, ""]
    num_steps: Int[Array, ""]


class StopAtRest(AbstractSolver):
    """A solver that stops after a number of consecutive steps with the largest force below a tolerance.

    It has two options in addition to those of the solver: `max_steps`, the maximum number of steps; and
    `num_steps`, an exact number of steps, without a test of the force.

    **Arguments:**

    - `solver`: computes the steps.
    - `consecutive_steps`: number of consecutive steps for which the force must stay below the tolerance.
    """

    solver: AbstractSolver
    consecutive_steps: int | Int[Array, ""] = 1

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> StopAtRestState:
        inner = self.solver.init(fn, y, args, options, f_struct, aux_struct, tags)
        state = self._count_steps_at_rest(inner, options, jnp.array(0), jnp.array(0))
        return eqx.tree_at(lambda s: s.num_steps, state, jnp.array(0))

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: StopAtRestState, tags: Any
    ) -> tuple[Any, StopAtRestState, Any]:
        y, inner, aux = self.solver.step(fn, y, args, options, state.inner, tags)
        return y, self._count_steps_at_rest(inner, options, state.num_below, state.num_steps), aux

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: StopAtRestState, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        if "num_steps" in options:
            done = state.num_steps >= options["num_steps"]
        else:
            done = self.at_rest(state) | jnp.isnan(state.force)
            done |= state.num_steps >= options.get("max_steps", jnp.inf)
        return done, optx.RESULTS.successful

    def at_rest(self, state: StopAtRestState) -> Bool[Array, ""]:
        """Whether the force was below the tolerance for `consecutive_steps`."""
        return state.num_below >= self.consecutive_steps

    def gradient(self, state: StopAtRestState) -> PyTree[Float[Array, "..."]]:
        """Gradient at the point that the last step (or `init`) returned."""
        return self.solver.gradient(state.inner)

    def _count_steps_at_rest(
        self, inner: Any, options: Any, num_below: Int[Array, ""], num_steps: Int[Array, ""]
    ) -> StopAtRestState:
        progress = self.solver.progress(inner)
        incremented = jnp.where(progress.force < Scales.of(options).tolerance, num_below + 1, 0)
        num_below = jnp.where(progress.accepted, incremented, num_below)
        return StopAtRestState(inner, progress.force, num_below, num_steps + progress.stepped)


class AtRest(AbstractSolver):
    """A minimiser that takes no step: it returns its initial point, which must be a minimum."""

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> None:
        return None

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: None, tags: Any
    ) -> tuple[Any, None, Any]:
        return y, None, None

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: None, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return jnp.array(True), optx.RESULTS.successful

    def gradient(self, state: None) -> None:
        return None
