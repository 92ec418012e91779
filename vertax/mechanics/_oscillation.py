"""Response to small oscillations: storage and loss moduli."""

from __future__ import annotations

from functools import partial
from typing import Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree
from scipy.sparse import diags_array

from vertax._base.announce import announced_jit
from vertax._base.checks import as_list, check_choice, check_number
from vertax._base.sparse_normal import factorised
from vertax._base.tracing import is_concrete, traced
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.mechanics._arguments import check_dissipation, check_system
from vertax.mechanics._elasticity import shear_part
from vertax.mechanics._hessian import (
    MAX_DENSE_SIZE,
    dense_hessian,
    movable,
    sparse_hessian,
)
from vertax.mechanics._landscape import (
    Landscape,
    area_of,
    dissipation_landscape,
    dot,
    stationary,
    voigt_basis,
)
from vertax.mesh import Tissue

_Args: TypeAlias = tuple[Tissue, AbstractEnergy, AbstractDissipation, Array]


def complex_modulus(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    frequencies: ArrayLike,
    *,
    angle: ArrayLike | None = None,
    method: Literal["dense", "sparse"] | None = None,
) -> Complex[Array, " frequencies"]:
    r"""The complex shear modulus $G^*(\omega) = G' + i G''$ of a tissue at rest, for small oscillations.

    With the Hessian $H$ of the energy and the matrix $\Gamma$ of the dissipation
    ($R = \tfrac12 \dot x \cdot \Gamma \dot x$), a strain $\epsilon e^{i\omega t}$ of the box moves the
    vertices by $u e^{i\omega t}$, and

    $$(H + i\omega\Gamma)\,u = -(\Xi + i\omega Z)\,\epsilon, \qquad
      G^*(\omega) = G_\mathrm{affine} + \frac1A \big( i\omega\,\Gamma_{\epsilon\epsilon}
      - (\Xi + i\omega Z)^T (H + i\omega\Gamma)^{-1} (\Xi + i\omega Z) \big)$$

    with the elastic forces $\Xi$ per affine strain and the dissipative forces $Z$ per affine strain rate
    ($Z = 0$ for friction with a substrate that deforms with the box). $G^*(0)$ is the relaxed
    [`shear_modulus`][vertax.mechanics.shear_modulus] and, with friction alone, $G^*(\infty)$ the affine
    one (Tong et al. 2022, doi:10.1371/journal.pcbi.1010135).

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `dissipation`: the dissipation $R$.
    - `frequencies`: angular frequencies $\omega$, one over time; not negative.
    - `angle`: direction of the shear, as in `shear_modulus`; by default the mean over all directions.
    - `method`: `"dense"` takes one decomposition of both matrices for all frequencies, works under
        `jax.jit`, `jax.vmap` and `jax.grad`, and its time grows with the cube of the number of cells.
        `"sparse"` takes one sparse factorisation for each frequency, on the host. It requires a local energy
        and a local dissipation, and is the default for them if the tissue has more than about 200 cells and
        no array is traced.

    **Returns:** one complex number per frequency, energy per area: real part $G'$, storage; imaginary part
        $G''$, loss. Differentiable as `elastic_tensor` is, with respect to the dissipation too. NaN
        (`"dense"`) if the energy decreases along a motion without dissipation: such a tissue is not at rest.

    **Raises:**

    - `TypeError` if `tissue`, `energy` or `dissipation` is an object of another class.
    - `TypeError` for `"sparse"` with an energy or a dissipation that is not local, or inside `jax.jit`.
    - `ValueError` for a free tissue, a negative frequency, frequencies that are not a list, or another
        method.
    """
    check_system(tissue, energy, box="a complex modulus")
    check_dissipation(dissipation)
    check_number("frequencies", frequencies, at_least=0, many=True)
    omegas = as_list("frequencies", jnp.atleast_1d(jnp.asarray(frequencies))).astype(
        tissue.vertices.dtype
    )
    check_choice("method", method, (None, "dense", "sparse"))
    args = (*traced((tissue, energy, dissipation), tissue.vertices.dtype), omegas)
    real, imaginary = _tensors_of(args, method)
    part = jax.vmap(lambda tensor: shear_part(tensor, angle))
    return jax.lax.complex(part(real), part(imaginary))


class _Oscillation(eqx.Module):
    """Real and imaginary part of the complex elastic tensor as stationary values."""

    def solve(self, args: _Args) -> PyTree[Array]:
        """Real and imaginary part of the non-affine motions, for each frequency and strain."""
        tissue, energy, dissipation, omegas = args
        elastic, viscous = Landscape(tissue, energy), dissipation_landscape(tissue, dissipation)
        unravel = ravel_pytree(tissue.configuration)[1]
        elastic_loads, viscous_loads = _affine_loads(elastic), _affine_loads(viscous)
        h, g, x = _diagonalise(dense_hessian(elastic), dense_hessian(viscous))
        denominator = h + 1j * omegas[:, None] * g
        # Modes with neither stiffness nor dissipation get the amplitude 0.
        size = jnp.max(jnp.abs(denominator), axis=1, keepdims=True)
        moves = jnp.abs(denominator) > _rounding(h.dtype) * size
        load = (elastic_loads @ x)[None] + 1j * omegas[:, None, None] * (viscous_loads @ x)[None]
        amplitude = jnp.where(moves, -1 / jnp.where(moves, denominator, 1), 0)[:, None] * load
        parts = jnp.stack([amplitude.real @ x.T, amplitude.imag @ x.T], axis=2)
        return jax.vmap(jax.vmap(jax.vmap(unravel)))(parts)

    def value(self, args: _Args, solution: PyTree[Array]) -> Float[Array, "2 frequencies 3 3"]:
        tissue, energy, dissipation, omegas = args
        strains = voigt_basis(tissue)[0]
        stiffness = jax.vmap(Landscape(tissue, energy).hessian_product())
        viscosity = jax.vmap(dissipation_landscape(tissue, dissipation).hessian_product())
        gram = lambda x, y: jax.vmap(lambda p: jax.vmap(partial(dot, p))(y))(x)
        symmetrised = lambda matrix: matrix + matrix.T

        # The motion is x + i y, and the tensor (x + i y)ᵀ (K + i ω Γ) (x + i y).
        def one(omega: Array, u: PyTree) -> Float[Array, "2 3 3"]:
            part = lambda i: jax.tree.map(lambda x: x[:, i], u)
            x = (strains, part(0))
            y = (jnp.zeros_like(strains), part(1))
            both_parts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), x, y)
            split = lambda z: (jax.tree.map(lambda a: a[:3], z), jax.tree.map(lambda a: a[3:], z))
            (kx, ky), (gx, gy) = split(stiffness(both_parts)), split(viscosity(both_parts))
            real = gram(x, kx) - gram(y, ky) - omega * symmetrised(gram(x, gy))
            imaginary = symmetrised(gram(x, ky)) + omega * (gram(x, gx) - gram(y, gy))
            return jnp.stack([real, imaginary])

        tensors = jax.vmap(one)(omegas, solution)
        return jnp.moveaxis(tensors, 1, 0) / area_of(tissue)


def _tensors_of(args: _Args, method: str | None) -> Float[Array, "2 frequencies 3 3"]:
    """Real and imaginary part of the tensors, by the given method or by the default."""
    tissue, energy, *_ = args
    large = ravel_pytree(tissue.configuration)[0].size > MAX_DENSE_SIZE
    if method == "sparse" or (method is None and large):
        local = isinstance(energy, AbstractLocalEnergy)
        motions = (
            _sparse_motions(args)
            if local and all(map(is_concrete, jax.tree.leaves(args)))
            else None
        )
        if motions is not None:
            return _tensors_along(args, motions)
        if method == "sparse":
            raise TypeError(
                'Argument `method` can be "sparse" only for an AbstractLocalEnergy and a dissipation in '
                "which vertices without a common cell do not interact, and outside of jax.jit, "
                'jax.vmap and jax.grad: pass method="dense".'
            )
    return _tensors(*args)


def _sparse_motions(args: _Args) -> PyTree[Array] | None:
    """As `_Oscillation.solve`, by a sparse factorisation for each frequency; None if a potential is not
    local."""
    tissue, energy, dissipation, omegas = args
    landscapes = Landscape(tissue, energy), dissipation_landscape(tissue, dissipation)
    hessians = [sparse_hessian(landscape) for landscape in landscapes]
    if any(matrix is None for matrix in hessians):
        return None
    free = np.flatnonzero(np.asarray(ravel_pytree(movable(tissue))[0]))
    stiff, viscous = (matrix[free][:, free] for matrix in hessians if matrix is not None)
    elastic_loads, viscous_loads = (
        np.asarray(_affine_loads(landscape), float)[:, free] for landscape in landscapes
    )
    # A support of 1e-10 of the mean diagonal (in float32, of the rounding) makes the matrix regular. Moduli
    # are stationary in the motions, so the error is of second order.
    sizes = [float(np.abs(matrix.diagonal()).mean()) for matrix in (stiff, viscous)]
    share = max(1e-10, 10 * float(jnp.finfo(tissue.vertices.dtype).eps))
    parts = np.zeros((omegas.size, 3, 2, ravel_pytree(tissue.configuration)[0].size))
    for i, omega in enumerate(np.asarray(omegas, float)):
        support = diags_array(np.full(free.size, share * (sizes[0] + omega * sizes[1])))
        # At zero frequency the system is real.
        rate = 1j * omega if omega else 0.0
        loads = elastic_loads + rate * viscous_loads
        motion = -factorised(stiff + rate * viscous + support).solve(loads.T).T
        parts[i, :, 0, free], parts[i, :, 1, free] = motion.real.T, motion.imag.T
    unravel = ravel_pytree(tissue.configuration)[1]
    return jax.vmap(jax.vmap(jax.vmap(unravel)))(jnp.asarray(parts, tissue.vertices.dtype))


@announced_jit
def _affine_loads(landscape: Landscape) -> Float[Array, "3 dofs"]:
    """Mixed second derivatives by displacements and by each of the affine strains, or strain rates."""
    loads = jax.vmap(landscape.hessian_product())(voigt_basis(landscape.tissue))[1]
    return jax.vmap(lambda x: ravel_pytree(x)[0])(loads)


@announced_jit
def _tensors_along(args: _Args, motions: PyTree[Array]) -> Float[Array, "2 frequencies 3 3"]:
    return _Oscillation().value(args, motions)


# An eigenvalue below minus this fraction of the largest one is negative. (The Hessian of a fluid tissue has
# small eigenvalues of either sign.)
_NEGATIVE = 1e-6


def _rounding(dtype: jnp.dtype) -> float:
    """Relative size below which numbers are rounding error."""
    return 1e3 * float(jnp.finfo(dtype).eps)


def _diagonalise(
    hessian: Float[Array, "dofs dofs"], viscosity: Float[Array, "dofs dofs"]
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"], Float[Array, "dofs dofs"]]:
    r"""Numbers h and g, and columns X with $X^T H X = h$ and $X^T \Gamma X = g$, both diagonal.

    Either matrix may have null vectors. The columns of common null vectors are 0. NaN if the energy decreases
    along a motion without dissipation.
    """
    scale = lambda a: jnp.maximum(jnp.max(jnp.sum(jnp.abs(a), axis=1)), jnp.finfo(a.dtype).tiny)
    h_scale, g_scale = scale(hessian), scale(viscosity)
    sizes, vectors = jnp.linalg.eigh(hessian / h_scale + viscosity / g_scale)
    nonzero = sizes > _rounding(sizes.dtype) * sizes[-1]
    unstable = sizes[0] < -max(_NEGATIVE, _rounding(sizes.dtype)) * sizes[-1]
    whitening = vectors * jnp.where(nonzero, 1 / jnp.sqrt(jnp.where(nonzero, sizes, 1)), 0)
    g, rotation = jnp.linalg.eigh(whitening.T @ (viscosity / g_scale) @ whitening)
    x = jnp.where(unstable, jnp.nan, whitening @ rotation)
    # h = 1 - g in these units, which cancels where g is nearly 1: so h is computed from H.
    h = jnp.sum(x * (hessian @ x), axis=0)
    return h, g_scale * g, x


@announced_jit
def _tensors(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    omegas: Float[Array, " frequencies"],
) -> Float[Array, "2 frequencies 3 3"]:
    # (The correction by the stress in `elastic_tensor` does not enter shear moduli.)
    return stationary((tissue, energy, dissipation, omegas), _Oscillation())
