"""Where another program came to rest, differentiated by equilibrium propagation."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from vertax.adjoints import EquilibriumPropagation, GradientOutcome
from vertax.adjoints._adjoint import differentiable, finish_gradient, frozen, materialise
from vertax.adjoints._propagation import NOT_LINEAR, Phase, RestoringForce, gradient_from_phases
from vertax.energies import AbstractEnergy
from vertax.energies._units import Units
from vertax.external._host import Request
from vertax.mesh import Tissue

_REASONS = (
    "The gradient by equilibrium propagation cannot be trusted: the program failed, or left a force that is "
    "not small beside the nudge. Let it relax further, raise `beta`, or allow it with "
    "EquilibriumPropagation(throw=False).",
    NOT_LINEAR,
)


def force_of(tissue: Tissue, energy: AbstractEnergy) -> PyTree[Array]:
    """The derivative of an energy with respect to the configuration."""
    return jax.grad(lambda y: energy(tissue.with_configuration(y)))(tissue.configuration)


class Rest(eqx.Module):
    """What is known of a tissue at rest."""

    tissue: Tissue
    slope: PyTree[Array]
    free: Bool[Array, " motions"]
    units: Units

    def balanced(self, pull: PyTree[Array]) -> PyTree[Array]:
        """A nudge less what would only carry the whole away."""
        vertices, rest = pull if isinstance(pull, tuple) else (pull, None)
        tissue = self.tissue
        if tissue.pinned is not None:
            vertices = jnp.where(tissue.pinned[:, None], 0, vertices)
        drift = lambda x: tissue.boundary.drift(x, tissue.vertices, tissue.pinned)
        modes = jax.jacobian(drift)(tissue.vertices)
        shares = self.free * jnp.sum(modes * vertices, axis=(1, 2))
        vertices = vertices - jnp.sum(shares[:, None, None] * modes, axis=0)
        return vertices if rest is None else (vertices, rest)


@eqx.filter_custom_vjp
def at_rest(
    vjp_arg: tuple[Any, Any, GradientOutcome | None],
    rest: Rest,
    response: Any,
    adjoint: EquilibriumPropagation,
) -> PyTree[Array]:
    return rest.tissue.configuration


@at_rest.def_fwd
def _(perturbed: Any, vjp_arg: Any, rest: Rest, *args: Any) -> tuple:
    return rest.tissue.configuration, None


@at_rest.def_bwd
def _(
    residuals: None,
    cotangent: PyTree,
    perturbed: Any,
    vjp_arg: Any,
    rest: Rest,
    response: Any,
    adjoint: EquilibriumPropagation,
) -> Any:
    energy, boundary, slot = vjp_arg
    tissue = rest.tissue
    moving, fixed = differentiable((energy, boundary))
    known = response.slope == "energy"

    def slope(there: Tissue) -> PyTree[Array]:
        def value(m: PyTree[Array]) -> Array:
            energy, boundary = eqx.combine(m, fixed)
            return energy(eqx.tree_at(lambda t: t.boundary, there, boundary))

        return jax.grad(value)(moving)

    def by_program(slope: PyTree[Array]) -> PyTree[Array]:
        # (What the energy does with the box is not known: its derivative is none.)
        return slope, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), moving[1])

    def phase(pull: PyTree[Array], strength: Array) -> Phase:
        vertices, torques = pull if isinstance(pull, tuple) else (pull, None)
        if torques is not None:
            torques = -torques * tissue.angle_length
        request = Request(tissue, frozen(energy), -vertices, torques)
        answer = response.ask(request, adjoint.throw)
        there = tissue.with_vertices(answer.vertices)
        if answer.angles is not None:
            there = there.with_angles(answer.angles)
        finite = jnp.all(jnp.isfinite(answer.vertices))
        if not known:
            left = jnp.where(jnp.isnan(answer.max_force) & finite, 0, answer.max_force)
            unknown = jnp.full_like(left, jnp.nan)
            return Phase(by_program(answer.slope), left, answer.num_steps, unknown)
        gradient = lambda y: force_of(there.with_configuration(y), frozen(energy))
        along = RestoringForce.along(gradient, tissue.configuration, there.configuration)
        left = optx.max_norm(jax.tree.map(jnp.add, along.force, pull))
        return Phase(slope(there), left, answer.num_steps, along.nonlinearity)

    pull = rest.balanced(materialise(cotangent, tissue.configuration))
    unpulled = None
    if not adjoint.centred:
        unpulled = slope(tissue) if known else by_program(rest.slope)
    sizes = {"stiffness": rest.units.stiffness, "length_scale": rest.units.length}
    # (The program may run twice at a time.)
    gradient, outcome = gradient_from_phases(adjoint, pull, sizes, phase, unpulled)
    (d_energy, d_boundary), outcome = finish_gradient(
        gradient, outcome, adjoint.throw, slot, _REASONS
    )
    return d_energy, d_boundary, outcome
