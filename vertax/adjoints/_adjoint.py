"""The abstract class of adjoints, and functions that all of them share."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Float, PyTree

from vertax._base.results import RESULTS, AbstractOutcome, checked, result_of


def _floating(x: ArrayLike) -> Array:
    # An outcome is returned in the place of a gradient, and gradients are floating-point arrays.
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))


class GradientOutcome(AbstractOutcome):
    r"""Diagnostics of a gradient through an equilibrium.

    All methods solve $H\,\lambda = \partial C / \partial X$, each in a different way, so their diagnostics
    are comparable.

    [`InverseProblem.value_and_gradient`][vertax.InverseProblem.value_and_gradient] and
    [`fit`][vertax.fit] return it. In plain JAX it is the "gradient" with respect to an empty outcome that is
    passed to the adjoint:

    ```python
    def loss(energy, outcome):
        adjoint = vx.ImplicitDifferentiation(outcome=outcome)
        return cost(vx.equilibrate(tissue, energy, adjoint=adjoint).tissue, energy)

    gradient, outcome = eqx.filter_grad(lambda x: loss(*x))((energy, vx.GradientOutcome()))
    ```
    """

    residual: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """Norm of the residual of the linear system, relative to its right-hand side; -1 if not available."""
    num_steps: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """Steps of the linear solver, of the nudged relaxations, or of the unrolled relaxation; -1 if not
    available."""
    negative_curvature: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """1 if the method detected a negative eigenvalue of the Hessian, so that the equilibrium is a saddle; -1
    if the method does not compute this. (A NaN would end each gradient with `jax_debug_nans`.)"""
    code: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """The index of `result`: gradients are floating-point arrays."""

    @property
    def result(self) -> RESULTS:
        """How the computation of the gradient ended; `successful` if the gradient is reliable.

        `degenerate`, or `nudge_not_linear`, if the equilibrium is not unique along motions that the cost
        depends on, so that the gradient does not exist.
        """
        return result_of(self.code)


class AbstractAdjoint(optx.AbstractAdjoint):
    """A method to differentiate through an equilibrium.

    1. [`equilibrate`][vertax.equilibrate] computes the equilibrium and its topology without gradients.
    2. The adjoint differentiates a minimisation in this topology that starts and ends at this equilibrium.

    The options of the minimisation are: `relaxation`, the minimiser of the first step; `start`, its
    configuration after the last T1 transition; `scales`, see [`Scales`][vertax.solvers.Scales]; and `exists`,
    false if energy or forces became NaN, so that there is no minimum to differentiate. An adjoint with
    `unrolls = True` needs a solver with `unrollable = True`.

    **Arguments:**

    - `throw`: raise an error for an unreliable gradient instead of returning it.
    - `outcome`: an empty [`GradientOutcome`][vertax.GradientOutcome]: its "gradient" is the outcome; reverse
        mode only.
    """

    unrolls: ClassVar[bool] = False

    throw: eqx.AbstractVar[bool]
    outcome: eqx.AbstractVar[GradientOutcome | None]

    def without_outcome(self) -> AbstractAdjoint:
        """A copy without diagnostics."""
        return eqx.tree_at(lambda a: a.outcome, self, None, is_leaf=lambda x: x is None)

    def with_outcome(self, outcome: GradientOutcome) -> AbstractAdjoint:
        """A copy with an empty outcome, to return diagnostics."""
        return eqx.tree_at(lambda a: a.outcome, self, outcome, is_leaf=lambda x: x is None)


MAX_RELATIVE_RESIDUAL = 0.01
"""The largest relative residual of a reliable gradient: of the linear system, or of the force on a nudged
tissue."""


def finish_gradient(
    gradient: PyTree,
    outcome: GradientOutcome,
    throw: bool,
    like: GradientOutcome | None,
    options: dict[str, Any] | None = None,
) -> tuple[PyTree, GradientOutcome | None]:
    """Raise an error for an unreliable gradient if `throw`, and cast the outcome to the dtypes of `like`.

    `options` are those of the minimisation: no error if there is no minimum.
    """
    if throw:
        minimum = jnp.asarray((options or {}).get("exists", True))
        result = RESULTS.where(minimum, outcome.result, RESULTS.successful)
        gradient = checked(gradient, result)
    if like is None:
        return gradient, None
    return gradient, jax.tree.map(lambda x, slot: jnp.asarray(x, slot.dtype), outcome, like)


def materialise(cotangent: PyTree[Array | None], like: PyTree[Array]) -> PyTree[Array]:
    """A cotangent with arrays in the place of symbolic zeros."""
    zero = lambda g, x: jnp.zeros_like(x) if g is None else g
    return jax.tree.map(zero, cotangent, like, is_leaf=lambda g: g is None)


def differentiable(tree: Any) -> tuple[Any, Any]:
    """The floating-point arrays of a pytree, and the rest."""
    return eqx.partition(tree, eqx.is_inexact_array)
