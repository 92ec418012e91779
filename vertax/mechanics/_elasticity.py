"""Elastic moduli: derivatives of the stress with respect to strain."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Float, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checks import as_scalar
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_linear_solver, check_system
from vertax.mechanics._landscape import (
    Landscape,
    area_of,
    checked,
    dot,
    solve,
    stationary,
    voigt_basis,
)
from vertax.mesh import Tissue
from vertax.solvers import MINRES


def elastic_tensor(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    affine: bool = False,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, "3 3"]:
    r"""The elastic tensor of a tissue at rest, in Voigt's notation, energy per area.

    The response of the (Cauchy) stress to a small strain, with the vertices relaxed:

    $$C_{ijkl} = \frac1A \left( \frac{\partial^2 E}{\partial\epsilon_{ij} \partial\epsilon_{kl}}
      - \Xi_{ij} \cdot H^+ \Xi_{kl} \right)
      - \tfrac12 (\sigma_{ij} \delta_{kl} + \delta_{ij} \sigma_{kl}),$$

    with logarithmic strain $F = e^\epsilon$ of box and vertices, the forces
    $\Xi_{ij} = \partial^2 E / \partial X \partial\epsilon_{ij}$ after an affine strain, and the
    pseudo-inverse of the Hessian $H$ (Lutsko 1989, doi:10.1063/1.342716; Merkel & Manning 2018,
    doi:10.1088/1367-2630/aaaa13). In a tissue under stress the moduli depend on the measure of strain. With
    the last term these are the stress-strain coefficients of Barron & Klein 1965
    (doi:10.1088/0370-1328/85/3/313), symmetrised: $\mathrm d\sigma / \mathrm d\epsilon$ itself if the
    stress is isotropic.

    Derivatives are exact and solve no further linear system, because moduli are stationary in the motion of
    the vertices. If the tissue is a result of [`equilibrate`][vertax.equilibrate], its adjoint adds the
    derivative of the equilibrium, and the sum is the derivative of the modulus of the relaxed tissue.

    **Arguments:**

    - `tissue`: a periodic tissue at rest. The contact energy of vertices that nearly meet is left out.
    - `energy`: the energy of which the tissue is at a minimum.
    - `affine`: if True, vertices follow the affine strain and do not relax.
    - `linear_solver`: for systems with the Hessian, [`MINRES`][vertax.MINRES] by default; if it fails, as it
        may in fluid tissues, it is repeated with a relative tolerance of $10^{-6}$.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** a symmetric matrix, shape `(3, 3)`, for the strains $\epsilon_{xx}$, $\epsilon_{yy}$ and
        $\gamma = 2 \epsilon_{xy}$.

    **Raises:**

    - `TypeError` if `tissue`, `energy` or `linear_solver` is an object of another class.
    - `ValueError` for a free tissue, or a batch of them.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the linear solver failed.
    """
    check_system(tissue, energy, box="an elastic modulus")
    check_linear_solver(linear_solver)
    tensor = _elastic_tensor(
        *traced((tissue, energy), tissue.vertices.dtype), _Elasticity(linear_solver, affine)
    )
    return checked(tensor, _REASON) if throw else tensor


def shear_modulus(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    angle: ArrayLike | None = None,
    affine: bool = False,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, ""]:
    r"""Shear modulus $G$ of a tissue at rest: stress over shear angle, energy per area.

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `angle`: direction of the shear, in radians from the x axis; 0 is $C_{xyxy}$, and π/4 pure shear
        along the axes. By default the mean over all directions, which does not depend on the axes:
        $(C_{xxxx} + C_{yyyy} - 2 C_{xxyy}) / 8 + C_{xyxy} / 2$.
    - `affine`, `linear_solver`, `throw`: see [`elastic_tensor`][vertax.mechanics.elastic_tensor].

    **Returns:** the modulus; differentiable as `elastic_tensor` is.

    **Raises:** as `elastic_tensor`.
    """
    tensor = elastic_tensor(tissue, energy, affine=affine, linear_solver=linear_solver, throw=throw)
    return shear_part(tensor, angle)


def bulk_modulus(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    affine: bool = False,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, ""]:
    r"""Bulk modulus $B$ of a tissue at rest: $A\,\mathrm d^2 E / \mathrm d A^2$ at a fixed box shape.

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `affine`, `linear_solver`, `throw`: see [`elastic_tensor`][vertax.mechanics.elastic_tensor].

    **Returns:** the modulus, energy per area; differentiable as `elastic_tensor` is.

    **Raises:** as `elastic_tensor`.
    """
    tensor = elastic_tensor(tissue, energy, affine=affine, linear_solver=linear_solver, throw=throw)
    return jnp.sum(tensor[:2, :2]) / 4


def youngs_modulus(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    angle: ArrayLike = 0.0,
    affine: bool = False,
    linear_solver: lx.AbstractLinearSolver[Any] = MINRES(),
    throw: bool = True,
) -> Float[Array, ""]:
    r"""Young's modulus along a direction: uniaxial stress over strain, at zero stress across.

    In an isotropic tissue it is $4 B G / (B + G)$. The elastic tensor must be regular.

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `angle`: the direction, in radians from the x axis.
    - `affine`, `linear_solver`, `throw`: see [`elastic_tensor`][vertax.mechanics.elastic_tensor].

    **Returns:** the modulus, energy per area; differentiable as `elastic_tensor` is.

    **Raises:** as `elastic_tensor`.
    """
    tensor = elastic_tensor(tissue, energy, affine=affine, linear_solver=linear_solver, throw=throw)
    return young_part(tensor, angle)


def young_part(tensor: Float[Array, "3 3"], angle: ArrayLike) -> Float[Array, ""]:
    """Young's modulus along a direction, from an elastic tensor."""
    angle = as_scalar("angle", angle)
    c, s = jnp.cos(angle), jnp.sin(angle)
    stress = jnp.stack([c**2, s**2, c * s]).astype(tensor.dtype)
    return 1 / (stress @ jnp.linalg.solve(tensor, stress))


def shear_part(tensor: Float[Array, "3 3"], angle: ArrayLike | None = None) -> Float[Array, ""]:
    """The shear modulus from an elastic tensor, along a direction or the mean over all directions."""
    if angle is None:
        return (tensor[0, 0] + tensor[1, 1] - 2 * tensor[0, 1]) / 8 + tensor[2, 2] / 2
    angle = as_scalar("angle", angle)
    c, s = jnp.cos(angle), jnp.sin(angle)
    # ε = (t n + n t) / 2 with t along the direction and n to its left.
    strain = jnp.stack([-c * s, c * s, c**2 - s**2]).astype(tensor.dtype)
    return strain @ tensor @ strain


class _Elasticity(eqx.Module):
    """The elastic tensor as a stationary value over the non-affine motions of the vertices."""

    solver: lx.AbstractLinearSolver[Any]
    affine: bool = eqx.field(static=True)

    def solve(self, args: tuple[Tissue, AbstractEnergy]) -> PyTree[Array]:
        """The non-affine motion of the vertices for each of the three strains, -H⁺ Ξ."""
        tissue, energy = args
        basis = voigt_basis(tissue)
        if self.affine:
            return basis[1]
        hessian_product = Landscape(tissue, energy).hessian_product()
        no_strain = jnp.zeros((2, 2), tissue.vertices.dtype)
        hessian = lambda change: hessian_product((no_strain, change))[1]
        affine_forces = jax.vmap(hessian_product)(basis)[1]
        rhs = jax.tree.map(jnp.negative, affine_forces)
        # In a fluid tissue some modes are as soft as the residual forces allow, and MINRES stagnates above
        # its default tolerance. A residual of 1e-6 is enough: the modulus is stationary in the solution, so
        # that its error is of second order.
        coarse = None
        if isinstance(self.solver, MINRES):
            coarse = MINRES(rtol=max(1e-6, float(jnp.finfo(tissue.vertices.dtype).eps) ** 0.5))
        # One by one: a batch would run until its slowest member has converged.
        return jax.lax.map(lambda one: solve(hessian, one, self.solver, coarse), rhs)

    def value(
        self, args: tuple[Tissue, AbstractEnergy], solution: PyTree[Array]
    ) -> Float[Array, "3 3"]:
        """The tensor for given non-affine motions."""
        tissue, energy = args
        landscape = Landscape(tissue, energy)
        motions = (voigt_basis(tissue)[0], solution)
        forces = jax.vmap(landscape.hessian_product())(motions)
        products = jax.vmap(lambda a: jax.vmap(partial(dot, a))(forces))(motions)
        # `products` are second derivatives by the logarithmic strain. The stress converts them to
        # derivatives of the stress.
        slope = landscape.gradient()[0]
        stress = jnp.stack([slope[0, 0], slope[1, 1], 0.5 * (slope[0, 1] + slope[1, 0])])
        trace = jnp.array([1.0, 1.0, 0.0], stress.dtype)
        prestress = jnp.outer(stress, trace)
        return (products - 0.5 * (prestress + prestress.T)) / area_of(tissue)


@announced_jit
def _elastic_tensor(
    tissue: Tissue, energy: AbstractEnergy, system: _Elasticity
) -> Float[Array, "3 3"]:
    return stationary((tissue, energy), system)


_REASON = (
    "The elastic tensor could not be computed: the linear solve with the Hessian failed. Relax the tissue to "
    "a smaller "
    "tolerance, give MINRES(rtol=..., max_steps=...) as `linear_solver`, or pass throw=False to get NaN."
)
