"""Automatic differentiation through the steps of a relaxation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.checks import check_integer, check_number
from vertax._base.optimistix import Minimisation
from vertax._base.results import RESULTS, index_of
from vertax._base.tracing import frozen
from vertax.adjoints._adjoint import (
    AbstractAdjoint,
    GradientOutcome,
    differentiable,
    finish_gradient,
    materialise,
)


class AutomaticDifferentiation(AbstractAdjoint):
    r"""Gradients through the unrolled steps of the relaxation (paper, Methods, "AD").

    Reverse mode, with binomial checkpointing: some steps are stored and the others are computed again in the
    backward pass. Only the steps after the last T1 transition are differentiated; their initial
    configuration is a constant.

    The derivative of the configuration converges later than the configuration: a tissue that starts at rest
    takes no step, and the gradient through no steps is 0. Therefore the steps continue at rest until the
    derivative along a random direction of the parameters has converged, or up to `max_steps`.

    The solver must have differentiable steps: gradient descent, or an Optax optimiser without a line
    search, such as `optax.sgd(1e-2, momentum=0.9)`.

    **Arguments:**

    - `checkpoints`: number of stored steps. Fewer need less memory and more time: 16 need 1.5 times the
        memory of equilibrium propagation, and 1.2 times the time of
        $\sqrt{2\,\mathtt{max\_steps}}$ checkpoints.
    - `rtol`: the derivative has converged when its residual force
        $H \frac{dX}{d\theta} + \nabla^2_{X\theta} E$ is smaller than its initial value by this factor.
        By default 1e-8 in float64 and 1e-3 in float32.
    - `throw`, `outcome`: see [`AbstractAdjoint`][vertax.adjoints.AbstractAdjoint]. A gradient is
        unreliable if it has not converged after `max_steps`.

    **Raises:**

    - `ValueError` for less than one checkpoint or an `rtol` that is not positive.
    """

    unrolls: ClassVar[bool] = True

    checkpoints: int = eqx.field(static=True, default=16)
    rtol: float | None = None
    throw: bool = eqx.field(default=True, kw_only=True)
    outcome: GradientOutcome | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        check_integer("checkpoints", self.checkpoints, at_least=1)
        if self.rtol is not None:
            check_number("rtol", self.rtol, above=0)

    def apply(
        self,
        primal_fn: Callable,
        rewrite_fn: Callable,
        inputs: PyTree,
        tags: frozenset[object],
    ) -> PyTree[Any]:
        minimisation = Minimisation.of(primal_fn, inputs)
        if not {"relaxation", "start", "max_steps"} <= minimisation.options.keys():
            raise TypeError(
                "AutomaticDifferentiation differentiates the relaxations of vertax.equilibrate."
            )
        root, residual = frozen(frozen(minimisation).run())
        vjp_arg = (minimisation.fn, minimisation.args, self.outcome)
        others = frozen(minimisation.replaced(fn=None, args=None))
        return _differentiate_steps(vjp_arg, root, others, self.without_outcome()), residual

    def _count_steps(self, fn: Callable, args: PyTree, options: dict[str, Any]) -> GradientOutcome:
        """Run the steps until the configuration and its derivative have converged, and count them."""
        # The state of a solver holds the gradient g(X_n, θ). Its derivative along a direction of θ,
        # H dX_n/dθ + ∂g/∂θ, is the residual of the linear system for dX/dθ.
        relaxation, y0 = options["relaxation"], options["start"]
        parameters, constants = differentiable(args)
        direction = _random_direction(parameters)

        def init(p: PyTree) -> tuple[tuple, tuple]:
            state = relaxation.init(fn, y0, eqx.combine(p, constants), options, None, None, None)
            return differentiable((y0, state))

        def step(p: PyTree, floats: tuple, others: tuple) -> tuple[tuple, tuple]:
            y, state = eqx.combine(floats, others)
            args = eqx.combine(p, constants)
            y, state, _ = relaxation.step(fn, y, args, options, state, None)
            return differentiable((y, state))

        def residual(tangents: tuple) -> Float[Array, ""]:
            _, state = tangents
            return optx.max_norm(relaxation.gradient(state))

        floats, tangents, others = jax.jvp(init, (parameters,), (direction,), has_aux=True)
        arrays, static = eqx.partition(others, eqx.is_array)
        initial = residual(tangents)
        rtol = (1e-8 if initial.dtype == jnp.float64 else 1e-3) if self.rtol is None else self.rtol

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            floats, tangents, arrays = carry
            _, state = eqx.combine(floats, arrays, static)
            converged = relaxation.at_rest(state) & (residual(tangents) <= rtol * initial)
            finite = jnp.isfinite(state.force) & jnp.isfinite(residual(tangents))
            return ~converged & finite & (state.num_steps < options["max_steps"])

        def body(carry: tuple) -> tuple:
            floats, tangents, arrays = carry
            function = lambda p, f: step(p, f, eqx.combine(arrays, static))
            floats, tangents, others = jax.jvp(
                function, (parameters, floats), (direction, tangents), has_aux=True
            )
            return floats, tangents, eqx.filter(others, eqx.is_array)

        floats, tangents, arrays = jax.lax.while_loop(unfinished, body, (floats, tangents, arrays))
        _, state = eqx.combine(floats, arrays, static)
        final = residual(tangents)
        failed = RESULTS.unrolling_not_converged
        return GradientOutcome(
            final / jnp.where(initial > 0, initial, 1),
            jnp.asarray(state.num_steps, final.dtype),
            -1.0,
            index_of(RESULTS.where(final <= rtol * initial, RESULTS.successful, failed)),
        )


def _random_direction(parameters: PyTree[Array]) -> PyTree[Array]:
    """A random change of all parameters, scaled by the size of each."""
    leaves, structure = jax.tree.flatten(parameters)
    keys = jax.random.split(jax.random.key(0), max(len(leaves), 1))

    def draw(key: Array, x: Array) -> Array:
        return jnp.where(x == 0, 1, jnp.abs(x)) * jax.random.normal(key, x.shape, x.dtype)

    return jax.tree.unflatten(structure, [draw(*pair) for pair in zip(keys, leaves, strict=False)])


@eqx.filter_custom_vjp
def _differentiate_steps(
    vjp_arg: tuple[Any, Any, GradientOutcome | None],
    root: PyTree[Array],
    others: Minimisation,
    adjoint: AutomaticDifferentiation,
) -> PyTree[Array]:
    return root  # without differentiation no second run is needed


@_differentiate_steps.def_fwd
def _(
    perturbed: Any,
    vjp_arg: Any,
    root: PyTree[Array],
    others: Minimisation,
    adjoint: AutomaticDifferentiation,
) -> tuple:
    fn, args, _ = vjp_arg
    options = others.options
    outcome = adjoint._count_steps(fn, args, options)
    unrolled = others.replaced(
        solver=options["relaxation"],
        y0=options["start"],
        options=options | {"num_steps": outcome.num_steps},
    )
    moving, fixed = differentiable((fn, args))

    def minimum(moving: PyTree) -> PyTree[Array]:
        fn, args = eqx.combine(moving, fixed)
        steps = unrolled.replaced(fn=fn, args=args)
        return steps.run("checkpointed", checkpoints=adjoint.checkpoints)[0]

    root, vjp = jax.vjp(minimum, moving)
    return root, (vjp, outcome)


@_differentiate_steps.def_bwd
def _(
    residuals: tuple,
    cotangent: PyTree,
    perturbed: Any,
    vjp_arg: Any,
    root: PyTree[Array],
    others: Minimisation,
    adjoint: AutomaticDifferentiation,
) -> Any:
    *_, slot = vjp_arg
    vjp, outcome = residuals
    (gradient,) = vjp(materialise(cotangent, root))
    (d_fn, d_args), outcome = finish_gradient(
        gradient, outcome, adjoint.throw, slot, others.options
    )
    return d_fn, d_args, outcome
