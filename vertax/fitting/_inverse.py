"""The inverse problem: parameters whose equilibrium minimises a cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checks import named
from vertax._base.memory_maps import warn_of_memory_maps
from vertax._base.modules import traced
from vertax.adjoints import (
    AbstractAdjoint,
    EquilibriumPropagation,
    GradientOutcome,
    ImplicitDifferentiation,
)
from vertax.adjoints._adjoint import finish_gradient, frozen
from vertax.adjoints._propagation import AbstractNudgedSystem, nudged_cost
from vertax.costs import AbstractCost
from vertax.dynamics import Evolved
from vertax.energies import AbstractEnergy
from vertax.energies._energy import check_energy, instance_hint
from vertax.energies._units import mean_stiffness, units_of
from vertax.mesh import Tissue
from vertax.relax import AbstractResponse, Equilibrium, Relaxation

Energy = TypeVar("Energy", bound=AbstractEnergy)


class Evaluation(eqx.Module):
    """A cost, its gradient, and how both came about."""

    cost: Float[Array, ""]
    equilibrium: Equilibrium
    gradient: PyTree[Array]
    """With respect to the trainable leaves of the energy; the others are None."""
    shift_gradient: Float[Array, 2] | None
    """With respect to the displacement of the whole; None if there is none."""
    outcome: GradientOutcome
    """How the gradient came about."""


class InverseProblem(eqx.Module, Generic[Energy]):
    r"""Find the parameters whose equilibrium minimises a cost (paper, "Bilevel optimization").

    $$\min_\theta C(X^*_\theta, \theta) \quad \text{subject to} \quad
      X^*_\theta \in \arg\min_X E(X, \theta)$$

    **Arguments:**

    - `tissue`: where the first relaxation starts; of a movement the first frame.
    - `energy`: the energy, with the first guess of its parameters.
    - `cost`: what to minimise.
    - `trainable`: which leaves of the energy are fitted: a predicate of a leaf, or a pytree of booleans
        shaped like the energy (as in `equinox.partition`). By default every floating-point array;
        Python floats are constants.
    - `fit_position`: fit also where the whole tissue lies. No parameter of an energy moves the centroid
        of a tissue, so a cost that sees positions (an image) needs this unless they are known.
    - `response`: how the tissue answers to its energy, a [`Relaxation`][vertax.Relaxation], or an
        [`Evolution`][vertax.Evolution] if it is on its way. Then the cost sees the last frame, or all if it
        is of [`Frames`][vertax.costs.Frames]; and the energy may be a
        [`Material`][vertax.dynamics.Material], of which what resists and what drives are fitted as well.
    - `adjoint`: how to differentiate, one of `vertax.adjoints`.
    - `guidance`: strength $\kappa$, energy per cost. If given, the tissue minimises $E + \kappa C$:
        the cost pulls it, through T1 transitions too, towards what it asks for, while the parameters
        are not yet such that it goes there by itself. See `guidance` of [`fit`][vertax.fit].

    **Raises:**

    - `TypeError` for a tissue, an energy, a cost, a response or an adjoint of another type.
    - `ValueError` for an adjoint, guidance or a fitted position that do not go with the response, or a cost
        of frames without an evolution.
    """

    tissue: Tissue
    energy: Energy
    cost: AbstractCost
    trainable: PyTree[bool] | Callable[[Any], bool] = eqx.is_inexact_array
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
                    f"Argument `{name}` must be {example}, but is {named(value)}.{remedy}"
                )
        check_energy(self.energy)
        self.response.goes_with(
            self.adjoint, guided=self.guidance is not None, placed=self.fit_position
        )
        if self.response.goes_on and self.cost.of_frames:
            raise ValueError(
                "Argument `cost` is one of several frames, and a relaxation has one: pass "
                "response=vertax.Evolution(dissipation, times)."
            )

    def __call__(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
        *,
        throw: bool = True,
    ) -> tuple[Float[Array, ""], Equilibrium]:
        """Cost and equilibrium for some parameters.

        **Arguments:**

        - `energy`: the energy, by default the problem's.
        - `tissue`: where the relaxation starts, by default the problem's tissue.
        - `shift`: a displacement of the relaxed tissue as a whole, by default none.
        - `throw`: raise an error if no equilibrium is reached. If False, look at `converged`.

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
        """Cost and equilibrium; `primal` is that of the response, or None if it is to be computed."""
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
        return self.cost(self._seen(equilibrium), energy), equilibrium

    @property
    def _nudged_by_cost(self) -> bool:
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
        return self.cost.residuals(self._seen(placed), energy), equilibrium, placed.tissue

    def _seen(self, equilibrium: Equilibrium) -> Tissue:
        """What the cost sees."""
        if self.cost.of_frames and isinstance(equilibrium, Evolved):
            return equilibrium.frames
        return equilibrium.tissue

    def onward(self, reached: Tissue) -> Tissue:
        """Where the next epoch starts after one has reached an equilibrium, or the end of a movement."""
        return reached if self.response.goes_on else self.tissue

    def value_and_gradient(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
        *,
        throw: bool = True,
    ) -> Evaluation:
        """Cost, equilibrium, gradient, and how the gradient came about.

        **Arguments:** as in a call of the problem.

        **Returns:** an [`Evaluation`][vertax.Evaluation].

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the relaxation did not converge; and
            for a gradient that cannot be trusted, unless the adjoint is told not to with `throw=False`.
        """
        warn_of_memory_maps()
        energy = self.energy if energy is None else energy
        tissue = self.tissue if tissue is None else tissue
        parameters, constants = eqx.partition(energy, self.trainable)
        dtype = tissue.vertices.dtype
        arguments = traced((tissue, parameters, constants, shift), dtype)
        tissue, parameters, constants, shift = arguments
        problem = self.bare(tissue)
        evaluation = problem.evaluate(*arguments)
        if self.adjoint.throw and not problem.adjoint.throw:
            outcome, reasons = evaluation.outcome, self.adjoint.reasons
            gradient, _ = finish_gradient(evaluation.gradient, outcome, True, None, reasons)
            evaluation = eqx.tree_at(lambda e: e.gradient, evaluation, gradient)
        if not throw:
            return evaluation
        return eqx.tree_at(lambda e: e.equilibrium, evaluation, evaluation.equilibrium.checked())

    def bare(self, tissue: Tissue) -> InverseProblem[Energy]:
        """What compiled functions need; problems with one cost and adjoint, strict or not, share them."""
        response = self.response.completed(tissue)
        problem = dataclasses.replace(self.as_data(tissue.vertices.dtype), response=response)
        parts = lambda p: (p.tissue, p.energy, p.trainable)
        problem = eqx.tree_at(parts, problem, (None,) * 3, is_leaf=lambda x: x is None)
        if not isinstance(response, Relaxation):
            return problem
        return eqx.tree_at(lambda p: p.adjoint.throw, problem, False)

    def evaluate(
        self,
        tissue: Tissue,
        parameters: PyTree[Array],
        constants: PyTree,
        shift: Float[Array, 2] | None,
    ) -> Evaluation:
        """Cost and gradient of a `bare` problem, by compiled functions."""
        primal = self.primal(eqx.combine(parameters, constants), tissue, shift)
        return _evaluate(self, primal, tissue, parameters, constants, shift)

    def primal(
        self, energy: AbstractEnergy, tissue: Tissue, shift: Float[Array, 2] | None
    ) -> PyTree:
        """The primal of the response; None if the response has none."""
        return self.response.primal(tissue, self.pulled(tissue, energy, shift))

    def as_data(self, dtype: Any) -> InverseProblem[Energy]:
        """The same problem with arrays for its numbers other than those of the energy."""
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
        """The equilibrium from `tissue`, not displaced; pulled by the cost where guided or nudged."""
        pulled = self.pulled(tissue, energy, shift, nudge)
        response = self.response if tolerance is None else self.response.finer(tolerance)
        if primal is None:
            equilibrium = response(tissue, pulled, adjoint=adjoint, throw=throw)
        else:
            equilibrium = response.attach(primal, tissue, pulled, adjoint)
        if pulled is energy:
            return equilibrium
        return eqx.tree_at(lambda e: e.energy, equilibrium, energy(equilibrium.tissue))

    def pulled(
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


@announced_jit
def _evaluate(
    problem: InverseProblem,
    primal: PyTree,
    tissue: Tissue,
    parameters: PyTree[Array],
    constants: PyTree,
    shift: Float[Array, 2] | None,
) -> Evaluation:
    """Cost and gradient where the primal of the response has led."""

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


class _Nudging(AbstractNudgedSystem):
    """An inverse problem at rest; its parameters are an energy and a displacement of the whole."""

    problem: InverseProblem
    settled: Tissue

    def cost(self, parameters: PyTree) -> Float[Array, ""]:
        energy, shift = parameters
        return self.problem.cost(_moved(self.settled, shift), energy)

    def sizes(self, parameters: PyTree) -> tuple[Float[Array, ""], Float[Array, ""]]:
        energy, shift = parameters
        cost = lambda tissue: self.problem.cost(_moved(tissue, shift), energy)
        at = lambda y: cost(self.settled.with_configuration(y))
        value, slope = jax.value_and_grad(at)(self.settled.configuration)
        units = units_of(self.settled, energy)
        # At the optimum of the cost its slope vanishes, and β has to stay so small that E - (β/2) C keeps
        # its minimum. A cost that counts neighbours has neither slope nor curvature: only a size.
        pull = jnp.maximum(optx.max_norm(slope), mean_stiffness(self.settled, cost) * units.length)
        pull = jnp.maximum(pull, 1e-8 * jnp.abs(value) / units.length)
        return jnp.where(pull > 0, pull, 1), units.force

    def relax(
        self, parameters: PyTree, nudge: Float[Array, ""], tolerance: Float[Array, ""]
    ) -> tuple[Tissue, Float[Array, ""], Float[Array, ""]]:
        energy, shift = parameters
        at_rest = self.problem.relax(
            self.settled,
            energy,
            shift,
            adjoint=ImplicitDifferentiation(),
            nudge=nudge,
            tolerance=tolerance,
        )
        return at_rest.tissue, at_rest.max_force, at_rest.num_steps.astype(nudge.dtype)

    def energy(
        self, parameters: PyTree, nudge: Float[Array, ""], state: Tissue
    ) -> Float[Array, ""]:
        energy, shift = parameters
        return self.problem.pulled(self.settled, energy, shift, nudge)(state)
