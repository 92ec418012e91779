"""Response to a small oscillation: storage and loss moduli."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from vertax._base.checks import as_real, check_number
from vertax._base.modules import traced
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.mechanics._elasticity import shear_part
from vertax.mechanics._landscape import (
    Landscape,
    area_of,
    checked,
    dissipation_landscape,
    dot,
    require_box,
    solve,
    stationary,
    voigt_basis,
)
from vertax.mesh import Tissue
from vertax.solvers import MINRES

_Args: TypeAlias = tuple[Tissue, AbstractEnergy, AbstractDissipation, Array]


def complex_modulus(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    frequencies: ArrayLike,
    *,
    angle: ArrayLike | None = None,
    linear_solver: lx.AbstractLinearSolver | None = None,
    throw: bool = True,
) -> Complex[Array, " frequencies"]:
    r"""The complex shear modulus $G^*(\omega) = G' + i G''$ of a tissue at rest, for small oscillations.

    With the Hessian $H$ of the energy and the matrix $\Gamma$ of the dissipation
    ($R = \tfrac12 \dot x \cdot \Gamma \dot x$), vertices move by $u e^{i\omega t}$ where the box is strained by
    $\epsilon e^{i\omega t}$, and

    $$(H + i\omega\Gamma)\,u = -(\Xi + i\omega Z)\,\epsilon, \qquad
      G^*(\omega) = G_\mathrm{affine} + \frac1A \big( i\omega\,\Gamma_{\epsilon\epsilon}
      - (\Xi + i\omega Z)^T (H + i\omega\Gamma)^{-1} (\Xi + i\omega Z) \big)$$

    with the forces $\Xi$ that an affine strain leaves and those, $Z$, that resist an affine rate of strain
    (0 for friction with a substrate that goes with the box). $G^*(0)$ is the relaxed
    [`shear_modulus`][vertax.mechanics.shear_modulus] and, with friction alone, $G^*(\infty)$ the affine one (Tong et al. 2022,
    doi:10.1371/journal.pcbi.1010135). All frequencies are one batch.

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy that it is at rest under.
    - `dissipation`: what resists.
    - `frequencies`: angular frequencies $\omega$, one over time; not negative.
    - `angle`: direction of the shear, as in `shear_modulus`; by default the mean over all.
    - `linear_solver`: for real symmetric indefinite systems, [`MINRES`][vertax.MINRES] by default.
    - `throw`: raise an error if the linear solver fails; otherwise the result is NaN.

    **Returns:** one complex number a frequency, energy per area: real part $G'$, storage; imaginary part $G''$,
        loss. Differentiable as `elastic_tensor` is, with respect to the dissipation too.

    **Raises:**

    - `ValueError` for a free tissue, or a negative frequency.
    - `RuntimeError` (of Equinox inside `jax.jit`) if `throw` and the linear solver failed.
    """
    require_box(tissue, "a complex modulus")
    check_number("frequencies", frequencies, least=0, many=True)
    omegas = jnp.atleast_1d(as_real("frequencies", frequencies)).astype(tissue.vertices.dtype)
    system = _Oscillation(MINRES() if linear_solver is None else linear_solver)
    tensors = _tensors(*traced((tissue, energy, dissipation)), omegas, system)
    real, imaginary = checked(tensors, _REASON) if throw else tensors
    part = jax.vmap(lambda tensor: shear_part(tensor, angle))
    return jax.lax.complex(part(real), part(imaginary))


class _Oscillation(eqx.Module):
    """Real and imaginary part of the elastic tensor as stationary values."""

    # (H + iωΓ) u = f is complex and symmetric, not Hermitian. For the real and the imaginary part of
    # u = a + i b it is real and symmetric: [[H, -ωΓ], [-ωΓ, -H]] [a, b] = [Re f, -Im f].
    solver: lx.AbstractLinearSolver

    def solve(self, args: _Args) -> PyTree[Array]:
        tissue, energy, dissipation, omegas = args
        basis = voigt_basis(tissue)
        stiff = Landscape(tissue, energy).curvature()
        viscous = dissipation_landscape(tissue, dissipation).curvature()
        still = jnp.zeros((2, 2), tissue.vertices.dtype)
        left, resisted = jax.vmap(stiff)(basis)[1], jax.vmap(viscous)(basis)[1]

        n = omegas.size

        def product_at(omega: Array) -> Callable[[PyTree], PyTree]:
            def product(u: PyTree[Array]) -> PyTree[Array]:
                # Real and imaginary part along a first axis.
                motions = jnp.zeros((2, 2, 2), omega.dtype), u
                h, g = jax.vmap(stiff)(motions)[1], jax.vmap(viscous)(motions)[1]
                sign = lambda x: jnp.array([1.0, -1.0], x.dtype).reshape(2, *[1] * (x.ndim - 1))
                return jax.tree.map(lambda h, g: sign(h) * h - omega * g[::-1], h, g)

            return product

        def one(omega: Array, xi: PyTree, z: PyTree) -> PyTree[Array]:
            rhs = jax.tree.map(lambda x, z: jnp.stack([-x, omega * z]), xi, z)
            return solve(product_at(omega), rhs, self.solver)

        # One batch of all frequencies and strains.
        each = lambda x: jnp.tile(x, (n,) + (1,) * (x.ndim - 1))
        found = jax.vmap(one)(
            jnp.repeat(omegas, 3), jax.tree.map(each, left), jax.tree.map(each, resisted)
        )
        return jax.tree.map(lambda x: x.reshape(n, 3, *x.shape[1:]), found)

    def value(self, args: _Args, solution: PyTree[Array]) -> Float[Array, "2 frequencies 3 3"]:
        tissue, energy, dissipation, omegas = args
        strains = voigt_basis(tissue)[0]
        stiff = jax.vmap(Landscape(tissue, energy).curvature())
        viscous = jax.vmap(dissipation_landscape(tissue, dissipation).curvature())
        table = lambda x, y: jax.vmap(lambda p: jax.vmap(partial(dot, p))(y))(x)
        both = lambda matrix: matrix + matrix.T

        def one(omega: Array, u: PyTree) -> Float[Array, "2 3 3"]:
            part = lambda i: jax.tree.map(lambda x: x[:, i], u)
            x = (strains, part(0))
            y = (jnp.zeros_like(strains), part(1))
            both_parts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), x, y)
            split = lambda z: (jax.tree.map(lambda a: a[:3], z), jax.tree.map(lambda a: a[3:], z))
            (kx, ky), (gx, gy) = split(stiff(both_parts)), split(viscous(both_parts))
            real = table(x, kx) - table(y, ky) - omega * both(table(x, gy))
            imaginary = both(table(x, ky)) + omega * (table(x, gx) - table(y, gy))
            return jnp.stack([real, imaginary])

        tensors = jax.vmap(one)(omegas, solution)
        return jnp.moveaxis(tensors, 1, 0) / area_of(tissue)


@eqx.filter_jit
def _tensors(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    omegas: Float[Array, " frequencies"],
    system: _Oscillation,
) -> Float[Array, "2 frequencies 3 3"]:
    # (A stress adds to the modulus of a change of area only, and shear is without.)
    return stationary((tissue, energy, dissipation, omegas), system)


_REASON = (
    "The complex modulus is not known: a linear solve with the Hessian and the dissipation failed. Relax the "
    "tissue to a smaller tolerance, give MINRES(rtol=..., max_steps=...) as `linear_solver`, or pass "
    "throw=False to get NaN."
)
