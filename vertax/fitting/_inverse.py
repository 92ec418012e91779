"""The inverse problem: find parameters such that the equilibrium minimises a cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree
from typing_extensions import TypeVar

from vertax._base.announce import announced_jit
from vertax._base.checks import describe
from vertax._base.memory_maps import warn_of_memory_maps
from vertax._base.model_checks import check_energy, instance_hint, real_scalar, warn_of_columns
from vertax._base.tracing import frozen, traced
from vertax.adjoints import (
    AbstractAdjoint,
    EquilibriumPropagation,
    GradientOutcome,
    ImplicitDifferentiation,
)
from vertax.adjoints._adjoint import finish_gradient
from vertax.adjoints._propagation import AbstractNudgedSystem, nudged_cost
from vertax.costs import AbstractCost
from vertax.dynamics import Evolved
from vertax.energies import AbstractEnergy
from vertax.energies._scales import mean_stiffness, scales_of
from vertax.mesh import Tissue
from vertax.relax import AbstractResponse, Equilibrium, Relaxation

Energy = TypeVar("Energy", bound=AbstractEnergy, default=Any)


class Evaluation(eqx.Module):
    """A cost, its gradient, the equilibrium, and diagnostics of the adjoint."""

    cost: Float[Array, ""]
    equilibrium: Equilibrium
    gradient: Any
    """With respect to the trainable leaves of the energy; the others are None."""
    shift_gradient: Float[Array, 2] | None
    """With respect to the displacement of the tissue; None without displacement."""
    outcome: GradientOutcome
    """Diagnostics of the adjoint."""


class InverseProblem(eqx.Module, Generic[Energy]):
    r"""Find parameters such that the equilibrium minimises a cost (paper, "Bilevel optimization").

    $$\min_\theta C(X^*_\theta, \theta) \quad \text{subject to} \quad
      X^*_\theta \in \arg\min_X E(X, \theta)$$

    **Arguments:**

    - `tissue`: the start of the first relaxation; for an evolution the first frame.
    - `energy`: the energy, with an initial guess of its parameters.
    - `cost`: the cost to minimise.
    - `trainable`: which leaves of the energy are fitted: a predicate of a leaf, or a pytree of booleans
        shaped like the energy (as in `equinox.partition`). By default every floating-point array;
        Python floats are constants.
    - `fit_position`: also fit a displacement of the tissue. The centroid of an equilibrium does not depend on
        the parameters of the energy, so a cost that depends on absolute positions (e.g. an image) needs this.
    - `response`: the forward model, a [`Relaxation`][vertax.Relaxation] to equilibrium or an
        [`Evolution`][vertax.Evolution] in time. With an evolution the cost takes the last frame, or all
        frames (see [`Frames`][vertax.costs.Frames]); and the energy may be a
        [`Material`][vertax.dynamics.Material], to fit dissipation and activity too.
    - `adjoint`: how to differentiate, one of `vertax.adjoints`.
    - `guidance`: strength $\kappa$, energy per cost. If given, the tissue minimises $E + \kappa C$, see
        `guidance` of [`fit`][vertax.fit].

    **Raises:**

    - `TypeError` for a tissue, an energy, a cost, a response or an adjoint of a wrong type.
    - `ValueError` for an adjoint, guidance or `fit_position` that the response does not support, or a cost of
        frames without an evolution.
    """

    tissue: Tissue
    energy: Energy
    cost: AbstractCost
    trainable: Any | Callable[[Any], bool] = eqx.is_inexact_array
    fit_position: bool = False
    response: AbstractResponse = eqx.field(default_factory=Relaxation)
    adjoint: AbstractAdjoint = eqx.field(default_factory=ImplicitDifferentiation)
    guidance: float | Float[Array, ""] | None = None

    def __check_init__(self):
        for name, kind, example in (
            ("tissue", Tissue, "a vertax.Tissue"),
            ("cost", AbstractCost, "a cost, e.g. vertax.costs.VertexDistance(target)"),
            ("response", AbstractResponse, "a response, e.g. vertax.Relaxation()"),
            ("adjoint", AbstractAdjoint, "an adjoint, e.g. vertax.ImplicitDifferentiation()"),
        ):
            value: Any = getattr(self, name)
            if not isinstance(value, kind):
                remedy = instance_hint(value)
                if name == "cost" and not remedy and callable(value):
                    remedy = (
                        " Make a function of tissue and energy the method `__call__` of a subclass of "
                        "vertax.AbstractCost."
                    )
                raise TypeError(
                    f"Argument `{name}` must be {example}, but is {describe(value)}.{remedy}"
                )
        check_energy(self.energy)
        self.response.check_compatible(
            self.adjoint, guided=self.guidance is not None, placed=self.fit_position
        )
        if self.response.supports_warm_start and self.cost.of_frames:
            raise ValueError(
                "Argument `cost` must be a cost of a single tissue for a relaxation, but is one of several "
                "frames. Pass response=vertax.Evolution(dissipation, times)."
            )
        if isinstance(self.energy, AbstractEnergy):
            warn_of_columns(self.energy, self.tissue)
            if not self.cost.of_frames:
                warn_of_columns(self.cost, self.tissue, self.energy)

    def __call__(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
        *,
        throw: bool = True,
    ) -> tuple[Float[Array, ""], Equilibrium]:
        """Cost and equilibrium for given parameters.

        **Arguments:**

        - `energy`: the energy, by default the problem's.
        - `tissue`: the start of the relaxation, by default the problem's tissue.
        - `shift`: a displacement of the relaxed tissue, by default none.
        - `throw`: raise an error if no equilibrium is reached. If False, check `converged`.

        **Returns:** the cost, differentiable in `energy` and `shift`, and the equilibrium.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the relaxation did not converge.
        """
        energy = self.energy if energy is None else energy
        tissue = self.tissue if tissue is None else tissue
        return self._cost_at(None, energy, tissue, shift, throw=throw)

    def _cost_at(
        self,
        primal: PyTree,
        energy: AbstractEnergy,
        tissue: Tissue,
        shift: Float[Array, 2] | None,
        *,
        throw: bool,
    ) -> tuple[Float[Array, ""], Equilibrium]:
        """Cost and equilibrium; `primal` is the result of `self.primal`, or None to compute it here."""
        if self._nudged_by_cost:
            start = frozen((tissue, energy, shift))
            adjoint = ImplicitDifferentiation()
            settled = frozen(self.relax(*start, adjoint=adjoint, primal=primal, throw=throw))
            adjoint = cast(EquilibriumPropagation, self.adjoint)
            problem = eqx.tree_at(
                lambda p: (p.adjoint, p.energy),
                self,
                (adjoint.without_outcome(), None),
                is_leaf=lambda x: x is None,
            )
            system = _Nudging(frozen(problem), settled.tissue)
            vjp_arg = ((energy, shift), adjoint.outcome)
            cost = nudged_cost(vjp_arg, system, problem.adjoint)
            return cost, _placed(settled, shift)
        relaxed = self.relax(
            tissue, energy, shift, adjoint=self.adjoint, primal=primal, throw=throw
        )
        equilibrium = _placed(relaxed, shift)
        value = self.cost(self._cost_argument(equilibrium), energy)
        return real_scalar(value, "cost"), equilibrium

    @property
    def _nudged_by_cost(self) -> bool:
        """Whether equilibrium propagation nudges with the full cost."""
        return isinstance(self.adjoint, EquilibriumPropagation) and self.adjoint.nudge == "cost"

    def residuals(
        self,
        energy: AbstractEnergy,
        tissue: Tissue,
        shift: Float[Array, 2] | None,
        primal: PyTree = None,
    ) -> tuple[Float[Array, " residuals"], Equilibrium, Tissue]:
        """Residuals of a least-squares cost, the equilibrium, and its tissue displaced by `shift`."""
        equilibrium = self.relax(tissue, energy, shift, adjoint=self.adjoint, primal=primal)
        placed = _placed(equilibrium, shift)
        return self.cost.residuals(self._cost_argument(placed), energy), equilibrium, placed.tissue

    def is_measurement(
        self, energy: AbstractEnergy, equilibrium: Equilibrium
    ) -> Bool[Array, " residuals"]:
        """Which residuals are measurements, see [`AbstractCost`][vertax.costs.AbstractCost]."""
        return self.cost.is_measurement(self._cost_argument(equilibrium), energy)

    def _cost_argument(self, equilibrium: Equilibrium) -> Tissue:
        """The tissue, or the frames, of which the cost is evaluated."""
        if self.cost.of_frames and isinstance(equilibrium, Evolved):
            return equilibrium.frames
        return equilibrium.tissue

    def next_start(self, reached: Tissue) -> Tissue:
        """Start of the next epoch: the last equilibrium (warm start), or the first frame of an evolution."""
        return reached if self.response.supports_warm_start else self.tissue

    def value_and_gradient(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
        *,
        throw: bool = True,
    ) -> Evaluation:
        """Cost, gradient, equilibrium, and diagnostics of the adjoint.

        **Arguments:** as in a call of the problem.

        **Returns:** an [`Evaluation`][vertax.Evaluation].

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the relaxation did not converge; and if
            the adjoint did not converge, unless the adjoint has `throw=False`.
        """
        warn_of_memory_maps()
        energy = self.energy if energy is None else energy
        tissue = self.tissue if tissue is None else tissue
        parameters, constants = eqx.partition(energy, self.trainable)
        dtype = tissue.vertices.dtype
        arguments = traced((tissue, parameters, constants, shift), dtype)
        tissue, parameters, constants, shift = arguments
        problem = self.without_parameters(tissue)
        evaluation = problem.evaluate(*arguments)
        if self.adjoint.throw and not problem.adjoint.throw:
            gradient, _ = finish_gradient(evaluation.gradient, evaluation.outcome, True, None)
            evaluation = eqx.tree_at(lambda e: e.gradient, evaluation, gradient)
        if not throw:
            return evaluation
        return eqx.tree_at(lambda e: e.equilibrium, evaluation, evaluation.equilibrium.checked())

    def without_parameters(self, tissue: Tissue) -> InverseProblem[Energy]:
        """The problem without the parts on which compiled functions do not depend.

        These are the tissue, the energy and, for relaxations, `throw` of the adjoint.
        """
        problem = self.with_array_numbers(tissue.vertices.dtype)
        parts = lambda p: (p.tissue, p.energy, p.trainable)
        problem = eqx.tree_at(parts, problem, (None,) * 3, is_leaf=lambda x: x is None)
        if not isinstance(problem.response, Relaxation):
            return problem
        return eqx.tree_at(lambda p: p.adjoint.throw, problem, False)

    def evaluate(
        self,
        tissue: Tissue,
        parameters: PyTree[Array],
        constants: PyTree,
        shift: Float[Array, 2] | None,
    ) -> Evaluation:
        """Cost and gradient of a problem from `without_parameters`, by compiled functions."""
        primal = self.primal(eqx.combine(parameters, constants), tissue, shift)
        return _evaluate(self, primal, tissue, parameters, constants, shift)

    def primal(
        self, energy: AbstractEnergy, tissue: Tissue, shift: Float[Array, 2] | None
    ) -> PyTree:
        """The forward computation of the response, to be passed to `evaluate`; None if it has none."""
        return self.response.primal(tissue, self.guided_energy(tissue, energy, shift))

    def with_array_numbers(self, dtype: Any) -> InverseProblem[Energy]:
        """The problem with arrays for its Python numbers, except those of the energy."""
        cost, guidance = traced((self.cost, self.guidance), dtype)
        response = self.response.traced()
        return dataclasses.replace(self, cost=cost, guidance=guidance, response=response)

    def relax(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        shift: Float[Array, 2] | None,
        *,
        adjoint: AbstractAdjoint,
        primal: PyTree = None,
        nudge: Float[Array, ""] | None = None,
        tolerance: Float[Array, ""] | None = None,
        throw: bool = False,
    ) -> Equilibrium:
        """The equilibrium from `tissue`, without displacement, of the guided and nudged energy."""
        guided = self.guided_energy(tissue, energy, shift, nudge)
        response = self.response if tolerance is None else self.response.finer(tolerance)
        if primal is None:
            equilibrium = response(tissue, guided, adjoint=adjoint, throw=throw)
        else:
            equilibrium = response.attach(primal, tissue, guided, adjoint)
        if guided is energy:
            return equilibrium
        return eqx.tree_at(lambda e: e.energy, equilibrium, energy(equilibrium.tissue))

    def guided_energy(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        shift: Float[Array, 2] | None,
        nudge: Float[Array, ""] | None = None,
    ) -> AbstractEnergy:
        """The energy that a relaxation from `tissue` minimises, with guidance and nudge."""
        if self.guidance is None and nudge is None:
            return energy
        strength = (0 if self.guidance is None else self.guidance) + (0 if nudge is None else nudge)
        strength = jnp.asarray(strength, tissue.vertices.dtype)
        return _GuidedEnergy(energy, self.cost, shift, strength, frozen(tissue))


@announced_jit
def _evaluate(
    problem: InverseProblem,
    primal: PyTree,
    tissue: Tissue,
    parameters: PyTree[Array],
    constants: PyTree,
    shift: Float[Array, 2] | None,
) -> Evaluation:
    """Cost and gradient at the equilibrium of the forward computation `primal`."""

    def cost(arguments: tuple) -> tuple[Array, Equilibrium]:
        parameters, shift, outcome = arguments
        adjoint = problem.adjoint.with_outcome(outcome)
        reporting = eqx.tree_at(lambda p: p.adjoint, problem, adjoint)
        energy = eqx.combine(parameters, constants)
        return reporting._cost_at(primal, energy, tissue, shift, throw=False)

    arguments = (parameters, shift, GradientOutcome())
    evaluate = jax.value_and_grad(cost, has_aux=True)
    (value, equilibrium), (gradient, shift_gradient, outcome) = evaluate(arguments)
    return Evaluation(value, equilibrium, gradient, shift_gradient, outcome)


def _displaced(tissue: Tissue, shift: Float[Array, 2] | None) -> Tissue:
    if shift is None:
        return tissue
    return tissue.with_vertices(tissue.vertices + shift)


def _placed(equilibrium: Equilibrium, shift: Float[Array, 2] | None) -> Equilibrium:
    return eqx.tree_at(lambda e: e.tissue, equilibrium, _displaced(equilibrium.tissue, shift))


class _GuidedEnergy(AbstractEnergy):
    r"""$E + \kappa C$."""

    energy: AbstractEnergy
    cost: AbstractCost
    shift: Float[Array, 2] | None
    strength: Float[Array, ""]
    start: Tissue

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        # Evaluate the cost with the centroid fixed at its start: for a cost that depends on absolute
        # positions, E + κ C would otherwise translate the tissue, without bound for one sign of κ.
        placed = _displaced(tissue.settled(self.start), self.shift)
        cost = real_scalar(self.cost(placed, self.energy), "cost")
        return self.energy(tissue) + self.strength * cost


class _Nudging(AbstractNudgedSystem):
    """An inverse problem at an equilibrium; its parameters are an energy and a displacement of the tissue."""

    problem: InverseProblem
    settled: Tissue

    def cost(self, parameters: PyTree) -> Float[Array, ""]:
        energy, shift = parameters
        return real_scalar(self.problem.cost(_displaced(self.settled, shift), energy), "cost")

    def sizes(self, parameters: PyTree) -> tuple[Float[Array, ""], Float[Array, ""]]:
        energy, shift = parameters
        cost = lambda tissue: self.problem.cost(_displaced(tissue, shift), energy)
        at = lambda y: cost(self.settled.with_configuration(y))
        value, gradient = jax.value_and_grad(at)(self.settled.configuration)
        scales = scales_of(self.settled, energy)
        # The force scale of the cost is the maximum of three estimates. The gradient vanishes at the optimum
        # of the cost, where the curvature bounds β so that E - (β/2) C keeps its minimum. A discrete cost
        # has neither gradient nor curvature, only a value.
        cost_force = jnp.maximum(
            optx.max_norm(gradient), mean_stiffness(self.settled, cost) * scales.length
        )
        cost_force = jnp.maximum(cost_force, 1e-8 * jnp.abs(value) / scales.length)
        return jnp.where(cost_force > 0, cost_force, 1), scales.force

    def relax(
        self, parameters: PyTree, nudge: Float[Array, ""], tolerance: Float[Array, ""]
    ) -> tuple[Tissue, Float[Array, ""], Float[Array, ""]]:
        energy, shift = parameters
        nudged = self.problem.relax(
            self.settled,
            energy,
            shift,
            adjoint=ImplicitDifferentiation(),
            nudge=nudge,
            tolerance=tolerance,
        )
        return nudged.tissue, nudged.max_force, nudged.num_steps.astype(nudge.dtype)

    def energy(
        self, parameters: PyTree, nudge: Float[Array, ""], state: Tissue
    ) -> Float[Array, ""]:
        energy, shift = parameters
        return self.problem.guided_energy(self.settled, energy, shift, nudge)(state)
