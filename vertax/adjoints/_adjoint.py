"""What every adjoint here has in common."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from vertax._base.tracing import is_concrete


def _floating(x: ArrayLike) -> Array:
    # An outcome is handed over as a gradient, and gradients are floating-point arrays.
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float))


class GradientOutcome(eqx.Module):
    r"""How a gradient through an equilibrium came about.

    All methods solve $H\,\lambda = \partial C / \partial X$ in their own way, so their outcomes compare.

    Plain JAX hands it over as the "gradient" with respect to an empty outcome that was given to the
    adjoint; [`InverseProblem.value_and_gradient`][vertax.InverseProblem.value_and_gradient] and
    [`fit`][vertax.fit] do that by themselves:

    ```python
    def loss(energy, outcome):
        adjoint = vx.ImplicitDifferentiation(outcome=outcome)
        return cost(vx.equilibrate(tissue, energy, adjoint=adjoint).tissue, energy)

    gradient, outcome = eqx.filter_grad(lambda x: loss(*x))((energy, vx.GradientOutcome()))
    ```
    """

    residual: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """What is left of the linear system, relative to its right-hand side."""
    num_steps: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """Steps of the linear solver, of the nudged relaxations, or of the unrolled relaxation."""
    negative_curvature: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """1 if the Hessian was seen to have a negative eigenvalue, so that the equilibrium is a saddle; NaN
    if the method cannot tell."""
    failed: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """1 if the gradient cannot be trusted, otherwise 0."""
    degenerate: Float[Array, "*batch"] = eqx.field(default=0.0, converter=_floating)
    """1 if the equilibrium is not unique along motions that the cost depends on, so that there is no
    gradient, or if these motions are too soft for the nudge of equilibrium propagation; NaN if the method
    cannot tell."""

    @property
    def trusted(self) -> Bool[Array, "*batch"]:
        """Whether the gradient can be trusted."""
        return self.failed == 0


class AbstractAdjoint(optx.AbstractAdjoint):
    """A way to differentiate through an equilibrium.

    [`equilibrate`][vertax.equilibrate] first finds the equilibrium and its topology without gradients.
    The adjoint then sees a minimisation in this topology that starts, and ends, there. The options of
    the minimisation hold what found it: the `relaxation`, a minimiser; the configuration that it set
    out from after the last T1 transition, `start`; and typical sizes, `stiffness` and `length_scale`.
    An adjoint that `unrolls` the steps of the relaxation needs a solver that is `unrollable`.

    **Arguments:**

    - `throw`: raise an error rather than return a gradient that cannot be trusted.
    - `outcome`: an empty [`GradientOutcome`][vertax.GradientOutcome], whose own "gradient" becomes the
        outcome; reverse mode only.
    """

    unrolls: ClassVar[bool] = False
    reasons: ClassVar[tuple[str, str]]
    """The errors for a gradient that cannot be trusted: in general, and where it is degenerate."""

    throw: eqx.AbstractVar[bool]
    outcome: eqx.AbstractVar[GradientOutcome | None]

    def without_outcome(self) -> AbstractAdjoint:
        """The same adjoint, which tells nobody how it went."""
        return eqx.tree_at(lambda a: a.outcome, self, None, is_leaf=lambda x: x is None)

    def with_outcome(self, outcome: GradientOutcome) -> AbstractAdjoint:
        """The same adjoint with somewhere to put its outcome."""
        return eqx.tree_at(lambda a: a.outcome, self, outcome, is_leaf=lambda x: x is None)


UNTRUSTED = 0.01
"""The largest relative residual of a gradient that counts as solved: of the linear system, or of the force of
a nudged tissue."""

DEGENERATE = (
    "the equilibrium is not unique. Along some motions (vertax.mechanics.zero_modes counts them) the tissue "
    "has no stiffness, and the cost depends on them. Use a cost of areas, perimeters or other shapes that "
    "these motions keep, pin vertices, or add a little stiffness"
)


def frozen(tree: PyTree) -> PyTree:
    """The same values, taken for constants by differentiation."""
    # (An array that is no tracer is a constant already, and a call of JAX takes ten microseconds.)
    constant = lambda x: x if is_concrete(x) else jax.lax.stop_gradient(x)
    return jax.tree.map(constant, tree)


def settle(
    gradient: PyTree,
    outcome: GradientOutcome,
    throw: bool,
    like: GradientOutcome | None,
    reasons: tuple[str, str],
) -> tuple[PyTree, GradientOutcome | None]:
    """Raise an error for a gradient that cannot be trusted, and shape the outcome as the slot it goes to.

    The second of the reasons is that of a degenerate equilibrium.
    """
    if throw:
        number = jnp.where(outcome.degenerate == 1, 1, 0)
        gradient = eqx.branched_error_if(gradient, ~outcome.trusted, number, reasons)
    if like is None:
        return gradient, None
    return gradient, jax.tree.map(lambda x, slot: jnp.asarray(x, slot.dtype), outcome, like)


def materialise(cotangent: PyTree[Array | None], like: PyTree[Array]) -> PyTree[Array]:
    """A cotangent with its symbolic zeros written out."""
    zero = lambda g, x: jnp.zeros_like(x) if g is None else g
    return jax.tree.map(zero, cotangent, like, is_leaf=lambda g: g is None)


def differentiable(tree: Any) -> tuple[Any, Any]:
    """The floating-point arrays of a pytree, and the rest."""
    return eqx.partition(tree, eqx.is_inexact_array)
