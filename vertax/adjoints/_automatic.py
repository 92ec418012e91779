"""Automatic differentiation through the steps of a relaxation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.optimistix import Minimisation
from vertax.adjoints._adjoint import (
    AbstractAdjoint,
    GradientOutcome,
    differentiable,
    frozen,
    materialise,
    settle,
)

_REASON = (
    "The gradient through the unrolled relaxation cannot be trusted: it had not converged when "
    "`max_steps` ended it. Raise `max_steps`, choose a faster solver such as "
    "Optax(optax.sgd(1e-2, momentum=0.9)), or allow it with AutomaticDifferentiation(throw=False)."
)


class AutomaticDifferentiation(AbstractAdjoint):
    r"""Gradients through the unrolled steps of the relaxation (paper, Methods, "AD").

    Reverse mode, with binomial checkpointing: of all steps a few are remembered and the others
    computed again on the way back. The steps are those after the last T1 transition, which start from
    a fixed configuration.

    A tissue may be at rest long before the derivative of its position is: one that starts at rest takes
    no step, and a gradient through no steps is zero. So the steps go on, at rest, until the derivative
    along a random direction of the parameters has converged too, or `max_steps` are done.

    It needs a solver whose steps can be differentiated: gradient descent, or an Optax optimiser without
    a line search, such as `optax.sgd(1e-2, momentum=0.9)`.

    **Arguments:**

    - `checkpoints`: number of remembered steps. Fewer take less memory and more time: 16 take half as
        much memory again as equilibrium propagation, and a fifth more time than
        $\sqrt{2\,\mathtt{max\_steps}}$ of them.
    - `rtol`: the derivative has converged when its residual force
        $H \frac{dX}{d\theta} + \nabla^2_{X\theta} E$ is smaller than its initial value by this factor.
        By default 1e-8 in float64 and 1e-3 in float32.
    - `throw`, `outcome`: see [`AbstractAdjoint`][vertax.adjoints.AbstractAdjoint]. A gradient is not
        trusted if `max_steps` ended it before it had converged.

    **Raises:**

    - `ValueError` for less than one checkpoint or an `rtol` that is not positive.
    """

    unrolls: ClassVar[bool] = True
    reasons: ClassVar[tuple[str, str]] = (_REASON, _REASON)

    checkpoints: int = eqx.field(static=True, default=16)
    rtol: float | None = None
    throw: bool = eqx.field(default=True, kw_only=True)
    outcome: GradientOutcome | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        if self.checkpoints < 1:
            raise ValueError(
                f"Argument `checkpoints` must be at least 1, but is {self.checkpoints}."
            )
        if self.rtol is not None and not self.rtol > 0:
            raise ValueError(f"Argument `rtol` must be positive, but is {self.rtol}.")

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
        return _unroll(vjp_arg, root, others, self.without_outcome()), residual

    def _rehearse(self, fn: Callable, args: PyTree, options: dict[str, Any]) -> GradientOutcome:
        """How many steps it takes until the position and its derivative are at rest."""
        # The gradient that a solver keeps in its state is g(X_n, θ). Its derivative along a direction of
        # θ, H dX_n/dθ + ∂g/∂θ, is what is left of the linear system that the derivative solves.
        relaxation, y0 = options["relaxation"], options["start"]
        parameters, constants = differentiable(args)
        direction = _random_direction(parameters)

        def begin(p: PyTree) -> tuple[tuple, tuple]:
            state = relaxation.init(fn, y0, eqx.combine(p, constants), options, None, None, None)
            return differentiable((y0, state))

        def step(p: PyTree, floats: tuple, others: tuple) -> tuple[tuple, tuple]:
            y, state = eqx.combine(floats, others)
            at = eqx.combine(p, constants)
            y, state, _ = relaxation.step(fn, y, at, options, state, None)
            return differentiable((y, state))

        def residual(tangents: tuple) -> Float[Array, ""]:
            _, state = tangents
            return optx.max_norm(relaxation.gradient(state))

        floats, tangents, others = jax.jvp(begin, (parameters,), (direction,), has_aux=True)
        arrays, static = eqx.partition(others, eqx.is_array)
        initial = residual(tangents)
        rtol = (1e-8 if initial.dtype == jnp.float64 else 1e-3) if self.rtol is None else self.rtol

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            floats, tangents, arrays = carry
            _, state = eqx.combine(floats, arrays, static)
            settled = relaxation.at_rest(state) & (residual(tangents) <= rtol * initial)
            finite = jnp.isfinite(state.force) & jnp.isfinite(residual(tangents))
            return ~settled & finite & (state.num_steps < options["max_steps"])

        def body(carry: tuple) -> tuple:
            floats, tangents, arrays = carry
            function = lambda p, f: step(p, f, eqx.combine(arrays, static))
            floats, tangents, others = jax.jvp(
                function, (parameters, floats), (direction, tangents), has_aux=True
            )
            return floats, tangents, eqx.filter(others, eqx.is_array)

        floats, tangents, arrays = jax.lax.while_loop(unfinished, body, (floats, tangents, arrays))
        _, state = eqx.combine(floats, arrays, static)
        left = residual(tangents)
        return GradientOutcome(
            left / jnp.where(initial > 0, initial, 1),
            jnp.asarray(state.num_steps, left.dtype),
            jnp.nan,
            jnp.asarray(~(left <= rtol * initial), left.dtype),
            jnp.nan,
        )


def _random_direction(parameters: PyTree[Array]) -> PyTree[Array]:
    """A change of all parameters that is of the order of each."""
    leaves, structure = jax.tree.flatten(parameters)
    keys = jax.random.split(jax.random.key(0), max(len(leaves), 1))

    def draw(key: Array, x: Array) -> Array:
        return jnp.where(x == 0, 1, jnp.abs(x)) * jax.random.normal(key, x.shape, x.dtype)

    return jax.tree.unflatten(structure, [draw(*pair) for pair in zip(keys, leaves, strict=False)])


@eqx.filter_custom_vjp
def _unroll(
    vjp_arg: tuple[Any, Any, GradientOutcome | None],
    root: PyTree[Array],
    others: Minimisation,
    adjoint: AutomaticDifferentiation,
) -> PyTree[Array]:
    # Who does not differentiate needs no second run.
    return root


@_unroll.def_fwd
def _(
    perturbed: Any,
    vjp_arg: Any,
    root: PyTree[Array],
    others: Minimisation,
    adjoint: AutomaticDifferentiation,
) -> tuple:
    fn, args, _ = vjp_arg
    options = others.options
    outcome = adjoint._rehearse(fn, args, options)
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

    root, pull = jax.vjp(minimum, moving)
    return root, (pull, outcome)


@_unroll.def_bwd
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
    pull, outcome = residuals
    (gradient,) = pull(materialise(cotangent, root))
    (d_fn, d_args), outcome = settle(gradient, outcome, adjoint.throw, slot, adjoint.reasons)
    return d_fn, d_args, outcome
