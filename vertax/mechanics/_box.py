"""Joint relaxation of a tissue and its periodic box, at a given stress or a given area."""

from __future__ import annotations

from typing import Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.checks import (
    as_matrix,
    as_real,
    check_choice,
    check_instance,
    check_integer,
    check_number,
    check_shape,
)
from vertax._base.results import RESULTS
from vertax._base.tracing import frozen, traced
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_system
from vertax.mechanics._elasticity import elastic_tensor
from vertax.mechanics._landscape import deformed
from vertax.mechanics._stress import stress
from vertax.mesh import Tissue
from vertax.relax import AbstractResponse, Equilibrium, Relaxation

# Orthogonal basis of the free strains, in components xx, yy and γ = 2 xy.
_FREE_STRAINS = {
    "all": np.eye(3),
    "area": np.array([[1.0, 1.0, 0.0]]),
    "shape": np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    "x": np.array([[1.0, 0.0, 0.0]]),
    "y": np.array([[0.0, 1.0, 0.0]]),
    "shear": np.array([[0.0, 0.0, 1.0]]),
}
# Largest strain of the box in one Newton step.
_MAX_STRAIN_STEP = 0.05


def _as_stress(value: ArrayLike) -> Float[Array, "2 2"]:
    stress = as_real("stress", value)
    check_shape("stress", stress, (), (2, 2))
    if stress.shape == ():
        return stress * jnp.eye(2, dtype=stress.dtype)
    return as_matrix("stress", stress, symmetric=True)


class BoxRelaxation(AbstractResponse):
    r"""Relax a tissue and its periodic box together, at a given stress or at a given area.

    The free components of the strain of the box are solved for such that the stress of the relaxed tissue
    equals the target in these components:

    $$\sigma_\mathrm{free} = \sigma_\mathrm{target}$$

    (Farhadifar et al. 2007, doi:10.1016/j.cub.2007.11.049, relax the box in this way). The method is Newton's
    with the [`elastic_tensor`][vertax.mechanics.elastic_tensor] as the Jacobian. The last Newton step is
    differentiated, which gives the derivative of the relaxed box. The box does not rotate.

    Pass it to an [`InverseProblem`][vertax.InverseProblem] as its response, or call it.

    **Arguments:**

    - `stress`: the target: a number, the isotropic stress (minus the external pressure), or a symmetric
        matrix; energy per area, positive in tension. 0 by default: no external load.
    - `free`: the free strains of the box: `"all"`; `"area"`, at a given shape; `"shape"`, at a given area; or
        only one strain, `"x"`, `"y"` or `"shear"`.
    - `relaxation`: the relaxation of the tissue in each box.
    - `tolerance`: the largest difference of stress at convergence; by default $10^{-9}$ of the largest
        modulus in float64, and $10^{-4}$ of it in float32.
    - `max_steps`: maximum number of Newton steps of the box.

    **Raises:**

    - `TypeError` if `relaxation` is not a `Relaxation`.
    - `ValueError` for a stress of the wrong shape or that is not symmetric, another `free`, or numbers that
        are not positive.
    """

    stress: Float[Array, "2 2"] = eqx.field(default=0.0, converter=_as_stress)
    free: Literal["all", "area", "shape", "x", "y", "shear"] = eqx.field(static=True, default="all")
    relaxation: Relaxation = eqx.field(default_factory=Relaxation)
    tolerance: float | Float[Array, ""] | None = None
    max_steps: int = eqx.field(static=True, default=50)

    def __check_init__(self):
        check_choice("free", self.free, tuple(_FREE_STRAINS))
        check_instance("relaxation", self.relaxation, Relaxation, "a vertax.Relaxation")
        if self.tolerance is not None:
            check_number("tolerance", self.tolerance, above=0)
        check_integer("max_steps", self.max_steps, at_least=1)

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint = ImplicitDifferentiation(),
        throw: bool = True,
    ) -> Equilibrium:
        """Relax a tissue and its box.

        **Arguments:**

        - `tissue`: the initial tissue, periodic.
        - `energy`: the energy to minimise, without the work of the external stress.
        - `adjoint`: the differentiation method, [`ImplicitDifferentiation`][vertax.ImplicitDifferentiation]
            by default; a method that unrolls a relaxation is rejected.
        - `throw`: raise an error if no equilibrium is reached. If False, check `converged`.

        **Returns:** an [`Equilibrium`][vertax.Equilibrium]; `energy` is the energy of the tissue alone.

        **Raises:**

        - `ValueError` for a free tissue, or an adjoint that unrolls.
        - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and no equilibrium was reached.
        """
        check_system(tissue, energy, box="a BoxRelaxation")
        self.relaxation.check(tissue, energy, adjoint)
        self.check_compatible(adjoint)
        relaxed = _relax_box(
            *traced((tissue, energy), tissue.vertices.dtype), self.traced(), adjoint
        )
        return relaxed.checked() if throw else relaxed

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Raise a `ValueError` for an adjoint that unrolls a relaxation.

        **Arguments:** as for every response.
        """
        if adjoint.unrolls:
            raise ValueError(
                f"{type(adjoint).__name__} differentiates the steps of one relaxation, and a box takes "
                "many: pass ImplicitDifferentiation or EquilibriumPropagation."
            )

    def traced(self) -> BoxRelaxation:
        """A copy with its numbers as arrays: other values need no recompilation."""
        parts = lambda r: (r.relaxation, r.tolerance)
        new = (self.relaxation.traced(), traced(self.tolerance))
        return eqx.tree_at(parts, self, new, is_leaf=lambda x: x is None)

    def finer(self, tolerance: Float[Array, ""]) -> BoxRelaxation:
        """A copy that also requires the largest force of the relaxation to be below this tolerance."""
        return eqx.tree_at(lambda r: r.relaxation, self, self.relaxation.finer(tolerance))


class _State(eqx.Module):
    tissue: Tissue
    stress_residual: Float[Array, " free"]
    """Target minus stress, in the free components."""
    stiffness: Float[Array, "free free"]
    modulus_scale: Float[Array, ""]
    num_t1: Int[Array, ""]
    num_steps: Int[Array, ""]
    num_box_steps: Int[Array, ""]


@announced_jit
def _relax_box(
    tissue: Tissue, energy: AbstractEnergy, response: BoxRelaxation, adjoint: AbstractAdjoint
) -> Equilibrium:
    constant_energy, constant_response = frozen(energy), frozen(response)
    basis = jnp.asarray(_FREE_STRAINS[response.free], tissue.vertices.dtype)
    default = 1e-9 if tissue.vertices.dtype == jnp.float64 else 1e-4

    def stress_residual(
        stressed: Float[Array, "2 2"], response: BoxRelaxation
    ) -> Float[Array, " free"]:
        difference = stressed - response.stress.astype(stressed.dtype)
        return -basis @ _voigt(difference)

    def at_rest(start: Tissue, before: _State | None) -> _State:
        relaxed = constant_response.relaxation.solve(
            start, constant_energy, ImplicitDifferentiation()
        )
        stressed, tensor = (
            stress(relaxed.tissue, constant_energy),
            elastic_tensor(relaxed.tissue, constant_energy, throw=False),
        )
        # dσ/dε is C plus a part that is not symmetric, which vanishes if the stress is isotropic.
        trace = jnp.array([1.0, 1.0, 0.0], tensor.dtype)
        product = jnp.outer(trace, _voigt(stressed))
        stiffness = basis @ (tensor + 0.5 * (product - product.T)) @ basis.T
        counts = (relaxed.num_t1, relaxed.num_steps, jnp.array(0))
        if before is not None:
            counts = (
                before.num_t1 + counts[0],
                before.num_steps + counts[1],
                before.num_box_steps + 1,
            )
        modulus_scale = jnp.max(jnp.abs(tensor))
        residual = stress_residual(stressed, constant_response)
        return _State(relaxed.tissue, residual, stiffness, modulus_scale, *counts)

    def has_converged(state: _State) -> Bool[Array, ""]:
        limit = (
            default * state.modulus_scale
            if constant_response.tolerance is None
            else constant_response.tolerance
        )
        return jnp.max(jnp.abs(state.stress_residual)) <= limit

    def strained(state: _State) -> Tissue:
        # Newton's step. If the stiffness is not positive definite, its eigenvalues are replaced by their
        # absolute values, so that the step descends.
        eigenvalues, vectors = jnp.linalg.eigh(0.5 * (state.stiffness + state.stiffness.T))
        is_definite = jnp.min(eigenvalues) > 1e-6 * state.modulus_scale
        newton = jnp.linalg.solve(state.stiffness, state.stress_residual)
        absolute = jnp.maximum(jnp.abs(eigenvalues), 1e-3 * state.modulus_scale)
        strain = jnp.where(
            is_definite, newton, vectors @ ((vectors.T @ state.stress_residual) / absolute)
        )
        size = jnp.max(jnp.abs(strain))
        strain = strain * jnp.minimum(1, _MAX_STRAIN_STEP / jnp.where(size > 0, size, 1))
        return deformed(state.tissue, _gradient(strain @ basis))

    first = at_rest(frozen(tissue), None)
    arrays, static = eqx.partition(first, eqx.is_array)

    def unfinished(arrays: _State) -> Bool[Array, ""]:
        finite = jnp.all(jnp.isfinite(arrays.stress_residual))
        return (
            ~has_converged(arrays) & finite & (arrays.num_box_steps < constant_response.max_steps)
        )

    def iterate(arrays: _State) -> _State:
        state = eqx.combine(arrays, static)
        return eqx.filter(at_rest(strained(state), state), eqx.is_array)

    end = frozen(eqx.combine(jax.lax.while_loop(unfinished, iterate, arrays), static))
    # One more Newton step, for its derivative: by the implicit function theorem dε/dθ = -C⁻¹ dσ/dθ, with the
    # derivative of the stress in this box.
    before = response.relaxation.solve(end.tissue, energy, adjoint)
    strain = jnp.linalg.solve(
        end.stiffness, stress_residual(stress(before.tissue, energy), response)
    )
    box = deformed(end.tissue, _gradient(strain @ basis)).boundary
    final = response.relaxation.solve(before.tissue.carried(box), energy, adjoint)
    result = RESULTS.where(has_converged(end), final.result, RESULTS.nonlinear_max_steps_reached)
    return Equilibrium(
        tissue=final.tissue,
        energy=final.energy,
        max_force=final.max_force,
        num_steps=end.num_steps + before.num_steps + final.num_steps,
        num_t1=end.num_t1 + before.num_t1 + final.num_t1,
        result=cast(RESULTS, result),
    )


def _voigt(matrix: Float[Array, "2 2"]) -> Float[Array, "3"]:
    return jnp.stack([matrix[0, 0], matrix[1, 1], 0.5 * (matrix[0, 1] + matrix[1, 0])])


def _gradient(strain: Float[Array, "3"]) -> Float[Array, "2 2"]:
    """The deformation gradient of a logarithmic strain, given its components xx, yy and γ."""
    half = 0.5 * strain[2]
    matrix = jnp.stack([jnp.stack([strain[0], half]), jnp.stack([half, strain[1]])])
    return jax.scipy.linalg.expm(matrix)
