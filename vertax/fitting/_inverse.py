"""The inverse problem: parameters whose equilibrium minimises a cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from vertax.adjoints import (
    AbstractAdjoint,
    EquilibriumPropagation,
    GradientOutcome,
    ImplicitDifferentiation,
)
from vertax.adjoints._adjoint import differentiable, frozen, settle
from vertax.adjoints._propagation import REASON, UNTRUSTED
from vertax.costs import AbstractCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.responses._relaxation import Equilibrium, equilibrate, mean_stiffness
from vertax.transitions import T1, AbstractTransitions

Energy = TypeVar("Energy", bound=AbstractEnergy)


class InverseProblem(eqx.Module, Generic[Energy]):
    r"""Find the parameters whose equilibrium minimises a cost (paper, "Bilevel optimization").

    $$\min_\theta C(X^*_\theta, \theta) \quad \text{subject to} \quad
      X^*_\theta \in \arg\min_X E(X, \theta)$$

    **Arguments:**

    - `tissue`: where the first relaxation starts.
    - `energy`: the energy, with the first guess of its parameters.
    - `cost`: what to minimise.
    - `trainable`: which leaves of the energy are fitted: a predicate of a leaf, or a pytree of booleans
        shaped like the energy (as in `equinox.partition`). By default every floating-point array;
        Python floats are constants.
    - `fit_position`: fit also where the whole tissue lies. No parameter of an energy moves the centroid
        of a tissue, so a cost that sees positions (an image) needs this unless they are known.
    - `adjoint`, `solver`, `transitions`, `tolerance`, `patience`, `max_steps`: passed on to
        [`equilibrate`][vertax.equilibrate].
    - `guidance`: strength $\kappa$, energy per cost. If given, the tissue minimises $E + \kappa C$:
        the cost pulls it, through T1 transitions too, towards what it asks for, while the parameters
        are not yet such that it goes there by itself. See `guidance` of [`fit`][vertax.fit].
    """

    tissue: Tissue
    energy: Energy
    cost: AbstractCost
    trainable: PyTree[bool] | Callable[[Any], bool] = eqx.is_inexact_array
    fit_position: bool = False
    adjoint: AbstractAdjoint = eqx.field(default_factory=ImplicitDifferentiation)
    solver: optx.AbstractMinimiser[Any, Any, Any] | None = None
    transitions: AbstractTransitions | None = T1()
    tolerance: float | Float[Array, ""] | None = None
    patience: int = 1
    max_steps: int = 2000
    guidance: float | Float[Array, ""] | None = None

    def __call__(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
    ) -> tuple[Float[Array, ""], Equilibrium]:
        """Cost and equilibrium for some parameters.

        **Arguments:**

        - `energy`: the energy, by default the problem's.
        - `tissue`: where the relaxation starts, by default the problem's tissue.
        - `shift`: a displacement of the relaxed tissue as a whole, by default none.

        **Returns:** the cost, differentiable in `energy` and `shift`, and the equilibrium.
        """
        energy = self.energy if energy is None else energy
        tissue = self.tissue if tissue is None else tissue
        if isinstance(self.adjoint, EquilibriumPropagation) and self.adjoint.nudge == "cost":
            settled = frozen(self._relax(*frozen((tissue, energy, shift)), adjoint=None))
            problem = eqx.tree_at(
                lambda p: (p.adjoint, p.energy), self, (self.adjoint.without_outcome(), None)
            )
            vjp_arg = (energy, shift, self.adjoint.outcome)
            cost = _cost_by_nudging(vjp_arg, frozen(problem), settled.tissue)
            return cost, _placed(settled, shift)
        equilibrium = _placed(self._relax(tissue, energy, shift, adjoint=self.adjoint), shift)
        return self.cost(equilibrium.tissue, energy), equilibrium

    def residuals(
        self, energy: AbstractEnergy, tissue: Tissue, shift: Float[Array, 2] | None
    ) -> tuple[Float[Array, " residuals"], Equilibrium, Tissue]:
        """Residuals of a least-squares cost, the equilibrium, and its tissue displaced by `shift`."""
        equilibrium = self._relax(tissue, energy, shift, adjoint=self.adjoint)
        placed = _moved(equilibrium.tissue, shift)
        return self.cost.residuals(placed, energy), equilibrium, placed

    def value_and_gradient(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
    ) -> tuple[
        Float[Array, ""], Equilibrium, tuple[PyTree[Array], Float[Array, 2] | None], GradientOutcome
    ]:
        """Cost, equilibrium, gradient, and how the gradient came about.

        **Arguments:** as in a call of the problem.

        **Returns:**

        - the cost;
        - the equilibrium;
        - the gradient with respect to the trainable leaves of the energy (the others are None) and with
            respect to `shift` (None if there is none);
        - the [`GradientOutcome`][vertax.GradientOutcome] of the adjoint.

        **Raises:**

        - `RuntimeError` (of Equinox) for a gradient that cannot be trusted, unless the adjoint is told
            not to with `throw=False`.
        """
        energy = self.energy if energy is None else energy
        parameters, constants = eqx.partition(energy, self.trainable)

        def cost(arguments: tuple) -> tuple[Array, Equilibrium]:
            parameters, shift, outcome = arguments
            adjoint = self.adjoint.with_outcome(outcome)
            problem = eqx.tree_at(lambda p: p.adjoint, self, adjoint)
            return problem(eqx.combine(parameters, constants), tissue, shift)

        arguments = (parameters, shift, GradientOutcome())
        (value, equilibrium), (*gradient, outcome) = jax.value_and_grad(cost, has_aux=True)(
            arguments
        )
        return value, equilibrium, tuple(gradient), outcome

    def _relax(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        shift: Float[Array, 2] | None,
        *,
        adjoint: AbstractAdjoint | None,
        nudge: Float[Array, ""] | None = None,
        **options: Any,
    ) -> Equilibrium:
        settings: dict[str, Any] = {
            "solver": self.solver,
            "transitions": self.transitions,
            "tolerance": self.tolerance,
            "patience": self.patience,
            "max_steps": self.max_steps,
        }
        pulled = self._pulled(tissue, energy, shift, nudge)
        found = equilibrate(tissue, pulled, adjoint=adjoint, throw=False, **settings | options)
        if pulled is energy:
            return found
        return eqx.tree_at(lambda e: e.energy, found, energy(found.tissue))

    def _pulled(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        shift: Float[Array, 2] | None,
        nudge: Float[Array, ""] | None = None,
    ) -> AbstractEnergy:
        """The energy that a relaxation from `tissue` minimises."""
        if self.guidance is None and nudge is None:
            return energy
        strength = (0 if self.guidance is None else self.guidance) + (0 if nudge is None else nudge)
        strength = jnp.asarray(strength, tissue.vertices.dtype)
        return _Pulled(energy, self.cost, shift, strength, frozen(tissue))


def _moved(tissue: Tissue, shift: Float[Array, 2] | None) -> Tissue:
    if shift is None:
        return tissue
    return tissue.with_vertices(tissue.vertices + shift)


def _placed(equilibrium: Equilibrium, shift: Float[Array, 2] | None) -> Equilibrium:
    return eqx.tree_at(lambda e: e.tissue, equilibrium, _moved(equilibrium.tissue, shift))


class _Pulled(AbstractEnergy):
    """An energy and a share of the cost."""

    energy: AbstractEnergy
    cost: AbstractCost
    shift: Float[Array, 2] | None
    strength: Float[Array, ""]
    start: Tissue

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        # A cost that sees positions would push the whole away without end, with one sign or the other:
        # it is that of the tissue moved back to where it was.
        placed = _moved(tissue.settled(self.start), self.shift)
        return self.energy(tissue) + self.strength * self.cost(placed, self.energy)


# Equilibrium propagation in the form of the paper: X± minimise E ± (β/2) C, with the whole cost and with
# T1 transitions, and the gradient is the difference of the partial derivatives of these two energies
# with respect to the parameters, over β.
@eqx.filter_custom_vjp
def _cost_by_nudging(
    vjp_arg: tuple[AbstractEnergy, Float[Array, 2] | None, GradientOutcome | None],
    problem: InverseProblem,
    settled: Tissue,
) -> Float[Array, ""]:
    energy, shift, _ = vjp_arg
    return problem.cost(_moved(settled, shift), energy)


@_cost_by_nudging.def_fwd
def _(perturbed: Any, vjp_arg: Any, problem: InverseProblem, settled: Tissue) -> tuple:
    energy, shift, _ = vjp_arg
    return problem.cost(_moved(settled, shift), energy), None


@_cost_by_nudging.def_bwd
def _(
    residuals: None,
    cotangent: Float[Array, ""],
    perturbed: Any,
    vjp_arg: Any,
    problem: InverseProblem,
    settled: Tissue,
) -> Any:
    energy, shift, slot = vjp_arg
    adjoint = problem.adjoint
    assert isinstance(adjoint, EquilibriumPropagation)
    half_beta, force = _nudge(problem, adjoint, settled, energy, shift)
    moving, fixed = differentiable((energy, shift))

    def phase(sign: Array) -> tuple[PyTree[Array], Equilibrium]:
        nudge = sign * half_beta
        tolerance = _tolerance(problem, adjoint, force)
        found = frozen(
            problem._relax(settled, energy, shift, adjoint=None, nudge=nudge, tolerance=tolerance)
        )

        def nudged(m: PyTree[Array]) -> Float[Array, ""]:
            energy, shift = eqx.combine(m, fixed)
            return problem._pulled(settled, energy, shift, nudge)(found.tissue)

        return jax.grad(nudged)(moving), found

    signs = jnp.asarray(adjoint.signs, half_beta.dtype)
    slopes, found = jax.vmap(phase)(signs)
    beta = half_beta * (signs[0] - signs[1])
    gradient = jax.tree.map(lambda s: cotangent * (s[0] - s[1]) / beta, slopes)
    residual = jnp.max(found.max_force) / force
    outcome = GradientOutcome(residual, jnp.sum(found.num_steps), jnp.nan, ~(residual < UNTRUSTED))
    (d_energy, d_shift), outcome = settle(gradient, outcome, adjoint.throw, slot, REASON)
    return d_energy, d_shift, outcome


def _nudge(
    problem: InverseProblem,
    adjoint: EquilibriumPropagation,
    settled: Tissue,
    energy: AbstractEnergy,
    shift: Float[Array, 2] | None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Half of β, and a force that it exerts if not at the optimum."""
    cost = lambda tissue: problem.cost(_moved(tissue, shift), energy)
    at = lambda y: cost(settled.with_configuration(y))
    value, slope = jax.value_and_grad(at)(settled.configuration)
    length = jnp.sqrt(jnp.mean(jnp.abs(settled.areas)))
    # At the optimum of the cost its slope vanishes, and β has to stay so small that E - (β/2) C keeps
    # its minimum. A cost that counts neighbours has neither slope nor curvature: only a size.
    pull = jnp.maximum(optx.max_norm(slope), mean_stiffness(settled, cost) * length)
    pull = jnp.maximum(pull, 1e-8 * jnp.abs(value) / length)
    pull = jnp.where(pull > 0, pull, 1)
    if adjoint.beta is not None:
        half_beta = jnp.asarray(adjoint.beta, value.dtype) / 2
    else:
        units = {"stiffness": mean_stiffness(settled, energy), "length_scale": length}
        half_beta = adjoint.strength(None, units, value.dtype) / pull
    return half_beta, half_beta * pull


def _tolerance(
    problem: InverseProblem, adjoint: EquilibriumPropagation, force: Float[Array, ""]
) -> Float[Array, ""]:
    tolerance = adjoint.tolerance(force)
    return tolerance if problem.tolerance is None else jnp.minimum(tolerance, problem.tolerance)
