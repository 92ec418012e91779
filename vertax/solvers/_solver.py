"""What every minimiser here knows: the force at the point it returns."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree
from optax import tree

from vertax._base.modules import choose

Rows: TypeAlias = PyTree[Float[Array, "..."]]
"""One number for each row of the arrays of a point: of a tissue one a vertex, and one an arc."""


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

    @property
    def evaluates_late(self) -> bool:
        """Whether a step finds value and gradient where it begins, so that `unevaluated` will do."""
        return False

    def unevaluated(self, y: Any, options: Any, f_struct: Any, aux_struct: Any) -> Any:
        """The state of `init`, but value and gradient are infinite: the objective was not looked at.

        Such a step knows the option `stays_below`: if no force is larger where it begins, it stays there.
        """
        raise NotImplementedError

    @abc.abstractmethod
    def gradient(self, state: Any) -> PyTree[Float[Array, "..."]]:
        """Gradient at the point that the last step (or `init`) returned."""

    def resumed(self, fresh: Any, old: Any, share: Rows, flipped: Bool[Array, ""]) -> Any:
        """Where a solver goes on when something other than itself has had a hand in its last step.

        By default it begins again where transitions changed the topology, or the step was cut short: what
        is remembered of the way there misleads.

        **Arguments:**

        - `fresh`: the state of `init` at the point where the solver is.
        - `old`: its last state, of which value and gradient are those of another point or objective.
        - `share`: which share of its last step each row of `y` has taken.
        - `flipped`: whether there were transitions.
        """
        begins = flipped | (jnp.asarray(tree.min(share)) < 1)
        return choose(begins, fresh, self.evaluated_anew(fresh, old))

    def evaluated_anew(self, fresh: Any, old: Any) -> Any:
        """The old state with what `fresh` knows of the objective; all of `fresh` if that is not known."""
        return fresh

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return self.norm(self.gradient(state)) < self.atol, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}


def value_and_gradient(fn: Callable, y: PyTree, args: PyTree) -> tuple[Array, PyTree, PyTree]:
    """Value, gradient and auxiliary output of an Optimistix objective `fn(y, args) -> (value, aux)`."""
    (value, aux), gradient = jax.value_and_grad(fn, has_aux=True)(y, args)
    return value, gradient, aux


def with_value_and_gradient(fresh: Any, old: Any) -> Any:
    """A state with the value and the gradient of another one."""
    return eqx.tree_at(lambda s: (s.value, s.gradient), old, (fresh.value, fresh.gradient))
