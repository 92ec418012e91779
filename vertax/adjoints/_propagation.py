"""Equilibrium propagation: gradients from relaxations of a nudged tissue."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from vertax._base.checks import check_choice, check_number
from vertax._base.optimistix import Minimisation, num_steps_of
from vertax._base.results import RESULTS, index_of
from vertax._base.scales import Scales
from vertax._base.tracing import frozen
from vertax.adjoints._adjoint import (
    MAX_RELATIVE_RESIDUAL,
    AbstractAdjoint,
    GradientOutcome,
    differentiable,
    finish_gradient,
    materialise,
)

# For a force h x + c x² / 2 under a nudge f the nonlinearity is η = ε / 4 with ε = c f / h². Expanding x in f
# gives the relative error of the gradient: ε / 2 = 2 η for one nudge, ε² / 2 = 8 η² for two opposite nudges.
# At η = 1/2 both errors are at least as large as the gradient. (A purely quadratic force has η = 1/2.)
_MAX_NONLINEARITY = 0.5


class EquilibriumPropagation(AbstractAdjoint):
    r"""Gradients from the response of the equilibrium to a nudge (paper, Methods, "EP").

    A weak force along the gradient of the cost displaces the equilibrium from $X^*$ to $X_{\pm\beta}$, and

    $$\frac{dC}{d\theta} = \lim_{\beta\to 0} \frac1\beta \left(\frac{\partial E}{\partial\theta}
      (X_{+\beta}, \theta) - \frac{\partial E}{\partial\theta}(X_{-\beta}, \theta)\right).$$

    It needs only relaxations and $\partial E / \partial \theta$: no second derivatives (other than
    those of the solver) and no linear system. Reverse mode only. (Scellier & Bengio 2017,
    doi:10.3389/fncom.2017.00024; centred: Laborieux et al. 2021, doi:10.3389/fnins.2021.633674.)

    **Arguments:**

    - `beta`: strength of the nudge. With `nudge="linear"` it is the largest nudging force in units of
        the mean stiffness times the size of a cell, so that the default suits every cost: 1e-5 in float64
        and 1e-3 in float32, because rounding errors dominate the response to a weaker nudge. With
        `nudge="cost"` it is the $\beta$ of the paper, energy per cost; by default it is chosen so that the
        nudging force is as above.
    - `nudge`: `"linear"` adds $\pm\tfrac\beta2\,\partial C/\partial X \cdot X$, a constant force on
        each vertex. `"cost"` adds $\pm\tfrac\beta2\,C$, and allows T1 transitions of the nudged tissue, so
        that a cost can depend on the topology; the relaxation needs the cost, so this works in an
        [`InverseProblem`][vertax.InverseProblem] only.
    - `centred`: relax with both signs, error $O(\beta^2)$; otherwise with one, error $O(\beta)$.
    - `rtol`: tolerance of the nudged relaxations relative to the nudging force; it never exceeds the
        tolerance of the first relaxation. By default 1e-6 in float64 and 1e-3 in float32.
    - `throw`, `outcome`: see [`AbstractAdjoint`][vertax.adjoints.AbstractAdjoint]. A gradient is
        unreliable if a nudged relaxation ends with a force above 1 % of the nudging force, or if the response
        to a linear nudge is not linear. Let $D$ be the displacement of a nudged tissue and $g(u)$ the
        gradient $\nabla_X E$ after the fraction $u$ of it. The ratio
        $(g(\tfrac12) - g(0)) \cdot D \,/\, (g(1) - g(0)) \cdot D$ is $\tfrac12$ for a linear response, and
        $2^{-p}$ for a force that grows as $u^p$. The response counts as linear if the ratio lies between
        1/4 and 3/4, $0.4 < p < 2$. Along motions without stiffness the ratio is outside: the force is zero
        ($p = 0$), or of higher order ($p \ge 2$).

    **Raises:**

    - `ValueError` for another nudge, or a `beta` or `rtol` that is not positive.
    """

    beta: float | Float[Array, ""] | None = None
    nudge: Literal["linear", "cost"] = eqx.field(static=True, default="linear")
    centred: bool = eqx.field(static=True, default=True)
    rtol: float | None = None
    throw: bool = eqx.field(default=True, kw_only=True)
    outcome: GradientOutcome | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        check_choice("nudge", self.nudge, ("linear", "cost"))
        for name, value in (("beta", self.beta), ("rtol", self.rtol)):
            if value is not None:
                check_number(name, value, above=0)

    def apply(
        self,
        primal_fn: Callable,
        rewrite_fn: Callable,
        inputs: PyTree,
        tags: frozenset[object],
    ) -> PyTree[Any]:
        minimisation = Minimisation.of(primal_fn, inputs)
        root, residual = frozen(frozen(minimisation).run())
        vjp_arg = (minimisation.fn, minimisation.args, self.outcome)
        others = frozen(minimisation.replaced(fn=None, args=None))
        return _propagate(vjp_arg, root, others, self.without_outcome()), residual

    def strength(
        self, beta: float | Float[Array, ""] | None, force: float | Float[Array, ""], dtype: Any
    ) -> Float[Array, ""]:
        """The largest nudging force, for a typical force of the system."""
        if beta is None:
            beta = 1e-5 if dtype == jnp.float64 else 1e-3
        return jnp.asarray(beta * force, dtype)

    def tolerance(self, strength: Float[Array, ""]) -> Float[Array, ""]:
        """Largest force at which a nudged tissue counts as relaxed."""
        rtol = self.rtol
        if rtol is None:
            rtol = 1e-6 if strength.dtype == jnp.float64 else 1e-3
        return rtol * strength

    @property
    def signs(self) -> tuple[float, ...]:
        """Signs of the nudges."""
        return (1.0, -1.0) if self.centred else (1.0, 0.0)


class _Nudged(eqx.Module):
    """An objective plus a term linear in the configuration: a constant force on each degree of freedom."""

    fn: Callable
    slope: PyTree[Array]

    def __call__(self, y: PyTree[Array], args: Any) -> tuple[Array, Any]:
        value, aux = self.fn(y, args)
        return value + jnp.asarray(optax.tree.vdot(self.slope, y)), aux


@eqx.filter_custom_vjp
def _propagate(
    vjp_arg: tuple[Any, Any, GradientOutcome | None],
    root: PyTree[Array],
    others: Minimisation,
    adjoint: EquilibriumPropagation,
) -> PyTree[Array]:
    return root


@_propagate.def_fwd
def _(perturbed: Any, vjp_arg: Any, root: PyTree[Array], *args: Any) -> tuple:
    return root, None


@_propagate.def_bwd
def _(
    residuals: None,
    cotangent: PyTree,
    perturbed: Any,
    vjp_arg: Any,
    root: PyTree[Array],
    others: Minimisation,
    adjoint: EquilibriumPropagation,
) -> Any:
    fn, args, slot = vjp_arg
    scales = Scales.of(others.options)
    # (`others.solver` may take no step, if the equilibrium is given. The nudged phases need the relaxation.)
    nudge = others.replaced(
        solver=others.options.get("relaxation", others.solver), y0=root, args=args
    )
    moving, fixed = differentiable((fn, args))

    def slope(y: PyTree[Array]) -> PyTree[Array]:
        def energy(m: PyTree[Array]) -> Array:
            fn, args = eqx.combine(m, fixed)
            return fn(y, args)[0]

        return jax.grad(energy)(moving)

    def phase(force: PyTree[Array], strength: Float[Array, ""]) -> Phase:
        nudged = _Nudged(fn, force)
        tolerance = jnp.minimum(scales.tolerance, adjoint.tolerance(strength))
        finer = dataclasses.replace(scales, tolerance=tolerance)
        options = others.options | {"scales": finer}
        y, residual = nudge.replaced(fn=nudged, options=options).run_as_constant()
        restoring = RestoringForce.along(jax.grad(lambda y: fn(y, args)[0]), root, y)
        max_force = optx.max_norm(jax.tree.map(jnp.add, restoring.force, force))
        return Phase(slope(y), max_force, num_steps_of(residual), restoring.nonlinearity)

    cotangent = materialise(cotangent, root)
    at_rest = None if adjoint.centred else slope(root)
    gradient, outcome = gradient_from_phases(adjoint, cotangent, scales, phase, at_rest)
    (d_fn, d_args), outcome = finish_gradient(
        gradient, outcome, adjoint.throw, slot, others.options
    )
    return d_fn, d_args, outcome


class Phase(NamedTuple):
    """The result of a relaxation under a nudge."""

    slope: PyTree[Array]
    """The partial derivative of the energy with respect to the parameters at the nudged equilibrium."""
    max_force: Float[Array, ""]
    """The largest force there."""
    num_steps: Array
    """Steps of the relaxation."""
    nonlinearity: Float[Array, ""]
    """See `RestoringForce`; NaN if it is not computed."""


class RestoringForce(NamedTuple):
    r"""The restoring force after a displacement $D$, and its nonlinearity.

    $$\eta = \lvert 2\,(g(\tfrac12) - g(0)) \cdot D \,/\, (g(1) - g(0)) \cdot D - 1 \rvert$$

    with the gradient $g$ of the energy after a fraction of the displacement. It is 0 for a quadratic energy,
    1 if the force over the first half of the displacement is 0, and $\lvert 2^{1 - p} - 1 \rvert$ for a
    force proportional to the power $p$ of the displacement.
    """

    force: PyTree[Array]
    nonlinearity: Float[Array, ""]

    @classmethod
    def along(
        cls, gradient: Callable[[PyTree[Array]], PyTree[Array]], start: PyTree, end: PyTree
    ) -> RestoringForce:
        """Evaluate the gradient at both ends of a displacement and at its midpoint."""
        displacement = jax.tree.map(jnp.subtract, end, start)
        points = jax.tree.map(
            lambda a, d, b: jnp.stack([a, a + d / 2, b]), start, displacement, end
        )
        # (A loop, so that the gradient is compiled once.)
        gradients = jax.lax.map(gradient, points)
        middle, final = (jax.tree.map(lambda g, i=i: g[i] - g[0], gradients) for i in (1, 2))
        half, work = (jnp.asarray(optax.tree.vdot(g, displacement)) for g in (middle, final))
        nonlinearity = jnp.abs(2 * half - work) / jnp.where(work == 0, 1, jnp.abs(work))
        return cls(jax.tree.map(lambda g: g[2], gradients), nonlinearity)


def gradient_from_phases(
    adjoint: EquilibriumPropagation,
    cotangent: PyTree[Array],
    scales: Scales,
    phase: Callable[[PyTree[Array], Float[Array, ""]], Phase],
    at_rest: PyTree[Array] | None,
) -> tuple[PyTree[Array], GradientOutcome]:
    """The gradient from relaxations under constant forces, and its outcome.

    **Arguments:**

    - `adjoint`: the strength and the signs of the nudges.
    - `cotangent`: derivative of the cost with respect to the configuration.
    - `scales`: typical sizes.
    - `phase`: a function that relaxes the nudged system. Its arguments are the coefficients of the linear
        term that is added to the energy, and the largest of them.
    - `at_rest`: the derivative of the energy by the parameters without a nudge, for a one-sided difference.

    **Returns:** the gradient, shaped as the derivatives; and its outcome.
    """
    size = optx.max_norm(cotangent)
    direction = optax.tree.scale(1 / jnp.where(size > 0, size, 1), cotangent)
    strength = adjoint.strength(adjoint.beta, scales.force, size.dtype)
    # The two signs are a batch. A one-sided difference needs no second relaxation.
    signs = jnp.asarray([s for s in adjoint.signs if s != 0], size.dtype)
    nudged = lambda sign: phase(optax.tree.scale(sign * strength, direction), strength)
    phases = jax.vmap(nudged)(signs)
    slopes = phases.slope
    if adjoint.centred:
        difference = jax.tree.map(lambda s: (s[0] - s[1]) / 2, slopes)
    else:
        difference = jax.tree.map(lambda s, at_rest: s[0] - at_rest, slopes, at_rest)
    gradient = jax.tree.map(lambda d: size / strength * d, difference)
    # (With a zero cotangent the displacement is rounding error.)
    nonlinearity = jnp.where(size > 0, jnp.max(phases.nonlinearity), 0)
    residual = jnp.max(phases.max_force) / strength
    return gradient, _gradient_outcome(residual, jnp.sum(phases.num_steps), nonlinearity)


class AbstractNudgedSystem(eqx.Module):
    """A system at rest that is nudged by its cost, as in the paper.

    The gradient is taken with respect to `parameters`.
    """

    @abc.abstractmethod
    def cost(self, parameters: PyTree) -> Float[Array, ""]:
        """The cost of the system at rest."""

    @abc.abstractmethod
    def sizes(self, parameters: PyTree) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The largest force of a nudge of strength 1, and the unit of force."""

    @abc.abstractmethod
    def relax(
        self, parameters: PyTree, nudge: Float[Array, ""], tolerance: Float[Array, ""]
    ) -> tuple[PyTree, Float[Array, ""], Float[Array, ""]]:
        """The nudged system at rest, the largest force on it, and the number of steps."""

    @abc.abstractmethod
    def energy(
        self, parameters: PyTree, nudge: Float[Array, ""], state: PyTree
    ) -> Float[Array, ""]:
        """The energy of the nudged system, nudge included."""


# Equilibrium propagation in the form of the paper, with the full cost and with T1 transitions:
#     X± = argmin E± with E± = E ± (β/2) C,    dC/dθ = (∂E₊/∂θ (X₊) - ∂E₋/∂θ (X₋)) / β.
@eqx.filter_custom_vjp
def nudged_cost(
    vjp_arg: tuple[PyTree, GradientOutcome | None],
    system: AbstractNudgedSystem,
    adjoint: EquilibriumPropagation,
) -> Float[Array, ""]:
    """The cost of a system; its gradient is computed from relaxations nudged by the cost."""
    parameters, _ = vjp_arg
    return system.cost(parameters)


@nudged_cost.def_fwd
def _(
    perturbed: Any, vjp_arg: Any, system: AbstractNudgedSystem, adjoint: EquilibriumPropagation
) -> tuple[Float[Array, ""], None]:
    parameters, _ = vjp_arg
    return system.cost(parameters), None


@nudged_cost.def_bwd
def _(
    residuals: None,
    cotangent: Float[Array, ""],
    perturbed: Any,
    vjp_arg: Any,
    system: AbstractNudgedSystem,
    adjoint: EquilibriumPropagation,
) -> Any:
    parameters, slot = vjp_arg
    force_per_nudge, unit = system.sizes(parameters)
    dtype = force_per_nudge.dtype
    if adjoint.beta is None:
        half_beta = adjoint.strength(None, unit, dtype) / force_per_nudge
    else:
        half_beta = jnp.asarray(adjoint.beta, dtype) / 2
    force = half_beta * force_per_nudge
    moving, fixed = differentiable(parameters)

    def phase(sign: Array) -> tuple[PyTree[Array], Array, Array]:
        nudge = sign * half_beta
        state, max_force, num_steps = frozen(
            system.relax(parameters, nudge, adjoint.tolerance(force))
        )
        energy = lambda m: system.energy(eqx.combine(m, fixed), nudge, state)
        return jax.grad(energy)(moving), max_force, num_steps

    signs = jnp.asarray(adjoint.signs, half_beta.dtype)
    slopes, max_forces, num_steps = jax.vmap(phase)(signs)
    beta = half_beta * (signs[0] - signs[1])
    gradient = jax.tree.map(lambda s: cotangent * (s[0] - s[1]) / beta, slopes)
    # (A nudge by the cost may be strong, and flip edges, so linearity is not checked.)
    outcome = _gradient_outcome(
        jnp.max(max_forces) / force, jnp.sum(num_steps), jnp.zeros_like(force)
    )
    return finish_gradient(gradient, outcome, adjoint.throw, slot)


def _gradient_outcome(
    residual: Float[Array, ""], num_steps: Array, nonlinearity: Float[Array, ""]
) -> GradientOutcome:
    at_rest = residual < MAX_RELATIVE_RESIDUAL
    result = RESULTS.where(at_rest, RESULTS.successful, RESULTS.nudge_not_at_rest)
    result = RESULTS.where(nonlinearity >= _MAX_NONLINEARITY, RESULTS.nudge_not_linear, result)
    return GradientOutcome(residual, num_steps, -1.0, index_of(result))
