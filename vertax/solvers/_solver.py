"""What every minimiser here knows: the force at the point it returns."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree


class AbstractSolver(optx.AbstractMinimiser):
    """An Optimistix minimiser that judges convergence by the largest force.

    Its state holds the gradient at the point that the last step returned, so the force is known there
    and costs nothing extra. It stops when the norm of the gradient (by default the largest component)
    falls below `atol`; [`equilibrate`][vertax.equilibrate] uses its own `tolerance` instead.
    """

    rtol: float = eqx.field(default=0.0, kw_only=True)
    atol: float = eqx.field(default=1e-8, kw_only=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(
        default=optx.max_norm, kw_only=True, static=True
    )

    @property
    def unrollable(self) -> bool:
        """Whether its steps can be differentiated one by one, as automatic differentiation does.

        Not so for line searches and inner loops, which decide by comparisons: the derivative of what
        they return is not the derivative of where they lead.
        """
        return False

    @abc.abstractmethod
    def gradient(self, state: Any) -> PyTree[Float[Array, "..."]]:
        """Gradient at the point that the last step (or `init`) returned."""

    def resumed(self, fresh: Any, old: Any) -> Any:
        """The state of `init` at the point where the solver is, with what else it remembers.

        This is asked for when the objective has changed a little: the solver needs its value and its
        gradient anew, but no more.
        """
        return fresh

    def retreat(
        self,
        fn: Any,
        y: Any,
        way: Any,
        args: Any,
        options: Any,
        state: Any,
        tags: Any,
        inside: Callable[[PyTree], Bool[Array, ""]],
    ) -> tuple[Any, Any]:
        """Where to go on, and in what state, after a step that must not be taken.

        **Arguments:**

        - `y`, `state`: those before the step.
        - `way`: the step, to `y + way`.
        - `inside`: which points are allowed, as `y` is.
        """
        at = lambda share: optax.tree.add_scale(y, share, way)
        too_far = lambda share: ~inside(at(share)) & (share > _LEAST_SHARE)
        share = jnp.asarray(0.5, optx.max_norm(way).dtype)
        share = jax.lax.while_loop(too_far, lambda share: 0.5 * share, share)
        y = at(jnp.where(share > _LEAST_SHARE, share, 0))
        struct = jax.eval_shape(fn, y, args)
        return y, self.init(fn, y, args, options, struct[0], struct[1], tags)

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return self.norm(self.gradient(state)) < self.atol, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}


_LEAST_SHARE = 1e-6


def value_and_gradient(fn: Callable, y: PyTree, args: PyTree) -> tuple[Array, PyTree, PyTree]:
    """Value, gradient and auxiliary output of an Optimistix objective `fn(y, args) -> (value, aux)`."""
    (value, aux), gradient = jax.value_and_grad(fn, has_aux=True)(y, args)
    return value, gradient, aux


def evaluated_anew(fresh: Any, old: Any) -> Any:
    """A state with the value and the gradient of another one."""
    return eqx.tree_at(lambda s: (s.value, s.gradient), old, (fresh.value, fresh.gradient))
