"""A stopping rule for minimisers: the largest force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax.solvers._solver import AbstractSolver


class StopAtRestState(eqx.Module):
    """State of a `StopAtRest`."""

    inner: PyTree
    force: Float[Array, ""]
    n_below: Int[Array, ""]
    num_steps: Int[Array, ""]


class StopAtRest(optx.AbstractMinimiser):
    """A solver that is at rest when the largest force has stayed below a tolerance for some steps.

    Options in addition to those of the solver: `tolerance`, the largest force at rest; `max_steps`, the
    largest number of steps; `num_steps`, an exact number of steps, whatever the force is.

    **Arguments:**

    - `solver`: takes the steps.
    - `consecutive_steps`: number of consecutive steps for which the force must stay below the tolerance.
    """

    solver: AbstractSolver
    consecutive_steps: int | Int[Array, ""] = 1
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(default=optx.max_norm, static=True)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> StopAtRestState:
        inner = self.solver.init(fn, y, args, options, f_struct, aux_struct, tags)
        state = self._judge(inner, options, jnp.array(0), jnp.array(0))
        return eqx.tree_at(lambda s: s.num_steps, state, jnp.array(0))

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: StopAtRestState, tags: Any
    ) -> tuple[Any, StopAtRestState, Any]:
        y, inner, aux = self.solver.step(fn, y, args, options, state.inner, tags)
        return y, self._judge(inner, options, state.n_below, state.num_steps), aux

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: StopAtRestState, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        if "num_steps" in options:
            done = state.num_steps >= options["num_steps"]
        else:
            done = self.at_rest(state) | jnp.isnan(state.force)
            done |= state.num_steps >= options.get("max_steps", jnp.inf)
        return done, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}

    def at_rest(self, state: StopAtRestState) -> Bool[Array, ""]:
        """Whether the force has been below the tolerance for long enough."""
        return state.n_below >= self.consecutive_steps

    def gradient(self, state: StopAtRestState) -> PyTree[Float[Array, "..."]]:
        """Gradient at the point that the last step (or `init`) returned."""
        return self.solver.gradient(state.inner)

    def _judge(
        self, inner: Any, options: Any, n_below: Int[Array, ""], num_steps: Int[Array, ""]
    ) -> StopAtRestState:
        progress = self.solver.progress(inner)
        below = jnp.where(progress.force < options["tolerance"], n_below + 1, 0)
        n_below = jnp.where(progress.accepted, below, n_below)
        return StopAtRestState(inner, progress.force, n_below, num_steps + progress.stepped)


class AtRest(optx.AbstractMinimiser):
    """Returns its initial point, which is a minimum."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(default=optx.max_norm, static=True)

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

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Any,
        options: Any,
        state: None,
        tags: Any,
        result: Any,
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}
