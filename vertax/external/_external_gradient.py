"""Derivatives of equilibria of external programs, by equilibrium propagation."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from vertax._base.scales import Scales
from vertax._base.tracing import frozen
from vertax.adjoints import EquilibriumPropagation, GradientOutcome
from vertax.adjoints._adjoint import differentiable, finish_gradient, materialise
from vertax.adjoints._propagation import Phase, RestoringForce, gradient_from_phases
from vertax.energies import AbstractEnergy
from vertax.external._host import Request
from vertax.mesh import Tissue


def force_of(tissue: Tissue, energy: AbstractEnergy) -> PyTree[Array]:
    """The derivative of an energy with respect to the configuration."""
    return jax.grad(lambda y: energy(tissue.with_configuration(y)))(tissue.configuration)


class ExternalEquilibrium(eqx.Module):
    """The equilibrium of a program without a nudge, its derivatives, rigid motions and typical sizes."""

    tissue: Tissue
    slope: PyTree[Array]
    free: Bool[Array, " motions"]
    scales: Scales

    def without_rigid_motion(self, pull: PyTree[Array]) -> PyTree[Array]:
        """The nudge minus its components along rigid motions without stiffness."""
        vertices, equilibrium = pull if isinstance(pull, tuple) else (pull, None)
        tissue = self.tissue
        if tissue.pinned is not None:
            vertices = jnp.where(tissue.pinned[:, None], 0, vertices)
        drift = lambda x: tissue.boundary.drift(x, tissue.vertices, tissue.pinned)
        modes = jax.jacobian(drift)(tissue.vertices)
        components = self.free * jnp.sum(modes * vertices, axis=(1, 2))
        vertices = vertices - jnp.sum(components[:, None, None] * modes, axis=0)
        return vertices if equilibrium is None else (vertices, equilibrium)


@eqx.filter_custom_vjp
def attach_gradient(
    vjp_arg: tuple[Any, Any, GradientOutcome | None],
    equilibrium: ExternalEquilibrium,
    response: Any,
    adjoint: EquilibriumPropagation,
) -> PyTree[Array]:
    return equilibrium.tissue.configuration


@attach_gradient.def_fwd
def _(perturbed: Any, vjp_arg: Any, equilibrium: ExternalEquilibrium, *args: Any) -> tuple:
    return equilibrium.tissue.configuration, None


@attach_gradient.def_bwd
def _(
    residuals: None,
    cotangent: PyTree,
    perturbed: Any,
    vjp_arg: Any,
    equilibrium: ExternalEquilibrium,
    response: Any,
    adjoint: EquilibriumPropagation,
) -> Any:
    energy, boundary, slot = vjp_arg
    tissue = equilibrium.tissue
    moving, fixed = differentiable((energy, boundary))
    slope_by_energy = response.slope == "energy"

    def slope(nudged: Tissue) -> PyTree[Array]:
        def value(m: PyTree[Array]) -> Array:
            energy, boundary = eqx.combine(m, fixed)
            return energy(eqx.tree_at(lambda t: t.boundary, nudged, boundary))

        return jax.grad(value)(moving)

    def by_program(slope: PyTree[Array]) -> PyTree[Array]:
        # (The program returns no derivative with respect to the box: NaN.)
        return slope, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), moving[1])

    def phase(pull: PyTree[Array], strength: Array) -> Phase:
        vertices, torques = pull if isinstance(pull, tuple) else (pull, None)
        if torques is not None:
            torques = -torques * tissue.angle_length
        request = Request(tissue, frozen(energy), -vertices, torques)
        result = response.run_simulator(request, adjoint.throw)
        nudged = tissue.with_vertices(result.vertices)
        if result.angles is not None:
            nudged = nudged.with_angles(result.angles)
        finite = jnp.all(jnp.isfinite(result.vertices))
        if not slope_by_energy:
            max_force = jnp.where(jnp.isnan(result.max_force) & finite, 0, result.max_force)
            nonlinearity = jnp.full_like(max_force, jnp.nan)
            return Phase(by_program(result.slope), max_force, result.num_steps, nonlinearity)
        gradient = lambda y: force_of(nudged.with_configuration(y), frozen(energy))
        restoring = RestoringForce.along(gradient, tissue.configuration, nudged.configuration)
        max_force = optx.max_norm(jax.tree.map(jnp.add, restoring.force, pull))
        return Phase(slope(nudged), max_force, result.num_steps, restoring.nonlinearity)

    pull = equilibrium.without_rigid_motion(materialise(cotangent, tissue.configuration))
    slope_at_rest = None
    if not adjoint.centred:
        slope_at_rest = slope(tissue) if slope_by_energy else by_program(equilibrium.slope)
    # (The two signs are a batch, so the program may run twice in parallel.)
    gradient, outcome = gradient_from_phases(
        adjoint, pull, equilibrium.scales, phase, slope_at_rest
    )
    (d_energy, d_boundary), outcome = finish_gradient(gradient, outcome, adjoint.throw, slot)
    return d_energy, d_boundary, outcome
