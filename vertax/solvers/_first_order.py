"""First-order minimisers: gradient descent and every Optax optimiser."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree

from vertax._base.checks import check_instance, check_integer, check_number
from vertax._base.scales import Scales
from vertax._base.tracing import is_concrete
from vertax.solvers._solver import AbstractSolver, value_and_gradient, with_value_and_gradient


class _State(eqx.Module):
    value: Float[Array, ""]
    gradient: PyTree[Float[Array, "..."]]
    optimiser: PyTree
    aux: PyTree


class GradientDescent(AbstractSolver):
    r"""Gradient descent with a fixed step, $X \leftarrow X - \eta\,\nabla E$ (paper, Methods).

    For comparison with the paper. It does not converge, but ends in two-cycles, if an eigenvalue of the
    Hessian exceeds $2/\eta$.

    **Arguments:**

    - `learning_rate`: step $\eta$, length squared per energy.

    **Raises:**

    - `ValueError` for a step that is not positive.
    """

    learning_rate: float | Float[Array, ""] = 1e-2

    def __check_init__(self):
        check_number("learning_rate", self.learning_rate, above=0, many=True)

    @property
    def unrollable(self) -> bool:
        return True

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _State:
        value, gradient, aux = value_and_gradient(fn, y, args)
        return _State(value, gradient, None, aux)

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Any, _State, Any]:
        y = optax.tree.add_scale(y, -self.learning_rate, state.gradient)
        value, gradient, aux = value_and_gradient(fn, y, args)
        return y, _State(value, gradient, None, aux), aux

    def gradient(self, state: _State) -> PyTree[Float[Array, "..."]]:
        return state.gradient

    def reevaluated(self, fresh: _State, old: _State) -> _State:
        return with_value_and_gradient(fresh, old)


class Optax(AbstractSolver):
    """Any Optax optimiser as the minimiser of the energy.

    **Arguments:**

    - `optimiser`: e.g. `optax.adam(1e-2)`. Schedules and optimisers with a line search (`optax.lbfgs()`)
        work; the latter get the value, the gradient and the function.

    **Raises:**

    - `TypeError` if it is not an Optax optimiser.
    """

    optimiser: optax.GradientTransformation = eqx.field(static=True)

    def __check_init__(self):
        expected = "an Optax optimiser, such as optax.adam(1e-2)"
        check_instance("optimiser", self.optimiser, optax.GradientTransformation, expected)

    @property
    def unrollable(self) -> bool:
        """Whether the optimiser has no line search, so that its steps are differentiable."""
        return not has_line_search(self.optimiser)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _State:
        value, gradient, aux = value_and_gradient(fn, y, args)
        return _State(value, gradient, self.optimiser.init(y), aux)

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Any, _State, Any]:
        def value_fn(x: Any) -> Array:
            # Line searches of Optax use the default precision, which may differ from that of the tissue.
            return fn(jax.tree.map(lambda a, b: a.astype(b.dtype), x, y), args)[0]

        update = optax.with_extra_args_support(self.optimiser).update
        updates, optimiser = update(
            state.gradient,
            state.optimiser,
            y,
            value=state.value,
            grad=state.gradient,
            value_fn=value_fn,
        )
        y = optax.apply_updates(y, updates)
        value, gradient, aux = value_and_gradient(fn, y, args)
        return y, _State(value, gradient, optimiser, aux), aux

    def gradient(self, state: _State) -> PyTree[Float[Array, "..."]]:
        return state.gradient

    def reevaluated(self, fresh: _State, old: _State) -> _State:
        return with_value_and_gradient(fresh, old)


def has_line_search(optimiser: optax.GradientTransformation) -> bool:
    """Whether an Optax optimiser evaluates the objective in its updates."""
    evaluated = []

    def objective(x: Array) -> Array:
        evaluated.append(True)
        return jnp.sum(x**2)

    def update(x: Array) -> Any:
        update = optax.with_extra_args_support(optimiser).update
        state = optimiser.init(x)
        return update(x, state, x, value=objective(x), grad=x, value_fn=objective)

    jax.eval_shape(update, jax.ShapeDtypeStruct((2,), jnp.float32))
    return len(evaluated) > 1


def LBFGS(history: int = 10) -> Optax:
    """Limited-memory BFGS with a zoom line search (Optax's).

    It stalls at forces near 1e-7 in float64, because of the rounding of the energy in its line search.

    **Arguments:**

    - `history`: number of stored steps for the approximate inverse Hessian.

    **Raises:**

    - `ValueError` for less than one.
    """
    check_integer("history", history, at_least=1)
    return Optax(optax.lbfgs(memory_size=history))


class _FIREState(eqx.Module):
    value: Float[Array, ""]
    gradient: PyTree[Float[Array, "..."]]
    velocity: PyTree[Float[Array, "..."]]
    time_step: Float[Array, ""]
    mixing: Float[Array, ""]
    num_downhill: Float[Array, ""]
    aux: PyTree


class FIRE(AbstractSolver):
    r"""Fast inertial relaxation engine (Bitzek et al. 2006, doi:10.1103/PhysRevLett.97.170201).

    Damped dynamics: while the power $F \cdot v$ is positive the time step grows, and when it becomes negative
    the velocity is set to 0. Semi-implicit Euler steps (Guénolé et al. 2020,
    doi:10.1016/j.commatsci.2020.109584).

    **Arguments:**

    - `time_step`: initial time step, for unit mass and a mean stiffness of 12 (of the paper's first
        energy); scaled with the period of oscillation for other stiffnesses.
    - `max_time_step`: largest time step, scaled likewise.
    - `max_displacement`: largest change of a coordinate in one step, in units of the length scale (in
        [`equilibrate`][vertax.equilibrate] the square root of the mean cell area; otherwise 1).

    **Raises:**

    - `ValueError` for a setting that is not positive, or a first time step above the largest.
    """

    time_step: float = 0.02
    max_time_step: float = 0.2
    max_displacement: float = 0.1

    def __check_init__(self):
        for name in ("time_step", "max_time_step", "max_displacement"):
            check_number(name, getattr(self, name), above=0, many=True)
        steps = (self.time_step, self.max_time_step)
        if all(is_concrete(step) for step in steps) and not np.all(steps[0] <= steps[1]):
            raise ValueError(
                "Argument `time_step` must be at most `max_time_step`, but they are "
                f"{steps[0]} and {steps[1]}."
            )

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _FIREState:
        value, gradient, aux = value_and_gradient(fn, y, args)
        scalar = lambda x: jnp.asarray(x, value.dtype)
        rest = optax.tree.zeros_like(y)
        return _FIREState(
            value,
            gradient,
            rest,
            scalar(self.time_step * _unit_of_time(options)),
            scalar(_INITIAL_MIXING),
            scalar(0),
            aux,
        )

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _FIREState, tags: Any
    ) -> tuple[Any, _FIREState, Any]:
        force = optax.tree.scale(-1, state.gradient)
        power = jnp.asarray(optax.tree.vdot(force, state.velocity))
        downhill = power > 0
        n_downhill = jnp.where(downhill, state.num_downhill + 1, 0)
        fast = n_downhill > _DELAY
        unit = _unit_of_time(options)
        dt = jnp.where(downhill, state.time_step, 0.5 * state.time_step)
        dt = jnp.where(fast, jnp.minimum(1.1 * dt, self.max_time_step * unit), dt)
        # A lower bound, because the step is halved in each step with negative power.
        dt = jnp.maximum(dt, 0.02 * self.time_step * unit)
        mixing = jnp.where(
            downhill, jnp.where(fast, 0.99 * state.mixing, state.mixing), _INITIAL_MIXING
        )

        velocity = jax.tree.map(lambda v: jnp.where(downhill, v, 0), state.velocity)
        velocity = optax.tree.add_scale(velocity, dt, force)
        speed, force_norm = optax.tree.norm(velocity), optax.tree.norm(force)
        steer = mixing * speed / jnp.where(force_norm > 0, force_norm, 1)
        velocity = jax.tree.map(lambda v, f: (1 - mixing) * v + steer * f, velocity, force)
        max_length = self.max_displacement * Scales.of(options).length
        length = dt * optax.tree.norm(velocity, ord=jnp.inf)
        scale = jnp.minimum(1.0, max_length / jnp.where(length > 0, length, 1))
        y = optax.tree.add_scale(y, scale * dt, velocity)
        value, gradient, aux = value_and_gradient(fn, y, args)
        return y, _FIREState(value, gradient, velocity, dt, mixing, n_downhill, aux), aux

    def gradient(self, state: _FIREState) -> PyTree[Float[Array, "..."]]:
        return state.gradient

    def reevaluated(self, fresh: _FIREState, old: _FIREState) -> _FIREState:
        return with_value_and_gradient(fresh, old)


def _unit_of_time(options: dict[str, Any]) -> Any:
    """The period of oscillation, relative to that of a stiffness of 12."""
    return (12 / options["scales"].stiffness) ** 0.5 if "scales" in options else 1.0


# Bitzek et al.: α_start = 0.1, and N_min = 5 steps with positive power before the time step grows.
_INITIAL_MIXING = 0.1
_DELAY = 5
