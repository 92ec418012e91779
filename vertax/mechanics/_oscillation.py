"""Response to a small oscillation: storage and loss moduli."""

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

from vertax._base.checks import as_real, check_number
from vertax._base.tracing import is_concrete, traced
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.mechanics._arguments import check_dissipation, check_system
from vertax.mechanics._elasticity import shear_part
from vertax.mechanics._hessian import DENSE, dense_hessian, factorised, movable, sparse_hessian
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
    ($R = \tfrac12 \dot x \cdot \Gamma \dot x$), vertices move by $u e^{i\omega t}$ where the box is
    strained by $\epsilon e^{i\omega t}$, and

    $$(H + i\omega\Gamma)\,u = -(\Xi + i\omega Z)\,\epsilon, \qquad
      G^*(\omega) = G_\mathrm{affine} + \frac1A \big( i\omega\,\Gamma_{\epsilon\epsilon}
      - (\Xi + i\omega Z)^T (H + i\omega\Gamma)^{-1} (\Xi + i\omega Z) \big)$$

    with the forces $\Xi$ that an affine strain leaves and those, $Z$, that resist an affine rate of strain
    (0 for friction with a substrate that goes with the box). $G^*(0)$ is the relaxed
    [`shear_modulus`][vertax.mechanics.shear_modulus] and, with friction alone, $G^*(\infty)$ the affine
    one (Tong et al. 2022, doi:10.1371/journal.pcbi.1010135).

    **Arguments:**

    - `tissue`: a periodic tissue at rest.
    - `energy`: the energy that it is at rest under.
    - `dissipation`: what resists.
    - `frequencies`: angular frequencies $\omega$, one over time; not negative.
    - `angle`: direction of the shear, as in `shear_modulus`; by default the mean over all.
    - `method`: `"dense"` takes one decomposition of both matrices for all frequencies, works under
        `jax.jit`, `jax.vmap` and `jax.grad`, and its time grows with the cube of the number of cells.
        `"sparse"` takes one sparse factorisation for each frequency, on the host: for large tissues whose
        energy and dissipation are local. By default that, if it can be and the tissue has more than 200
        cells or so.

    **Returns:** one complex number a frequency, energy per area: real part $G'$, storage; imaginary part
    $G''$,
        loss. Differentiable as `elastic_tensor` is, with respect to the dissipation too. NaN (`"dense"`) if
        the energy falls along a motion that nothing resists: such a tissue is not at rest.

    **Raises:**

    - `TypeError` for what is no tissue, no energy or no dissipation.
    - `TypeError` for `"sparse"` with an energy or a dissipation that is not local, or inside `jax.jit`.
    - `ValueError` for a free tissue, a negative frequency, no list of them, or another method.
    """
    check_system(tissue, energy, box="a complex modulus")
    check_dissipation(dissipation)
    check_number("frequencies", frequencies, at_least=0, many=True)
    omegas = jnp.atleast_1d(as_real("frequencies", frequencies)).astype(tissue.vertices.dtype)
    if omegas.ndim != 1 or omegas.size == 0:
        raise ValueError(
            f"Argument `frequencies` must be a list of numbers, but its shape is {omegas.shape}."
        )
    if method not in (None, "dense", "sparse"):
        raise ValueError(f'Argument `method` must be "dense" or "sparse", but is {method!r}.')
    args = (*traced((tissue, energy, dissipation), tissue.vertices.dtype), omegas)
    real, imaginary = _tensors_of(args, method)
    part = jax.vmap(lambda tensor: shear_part(tensor, angle))
    return jax.lax.complex(part(real), part(imaginary))


class _Oscillation(eqx.Module):
    """Real and imaginary part of the elastic tensor as stationary values."""

    def solve(self, args: _Args) -> PyTree[Array]:
        """Real and imaginary part of how vertices move by themselves, for each frequency and strain."""
        tissue, energy, dissipation, omegas = args
        elastic, viscous = Landscape(tissue, energy), dissipation_landscape(tissue, dissipation)
        unravel = ravel_pytree(tissue.configuration)[1]
        left, resisted = _loads(elastic), _loads(viscous)
        h, g, x = _simultaneously_diagonal(dense_hessian(elastic), dense_hessian(viscous))
        denominator = h + 1j * omegas[:, None] * g
        # What neither costs energy nor is resisted does not move.
        size = jnp.max(jnp.abs(denominator), axis=1, keepdims=True)
        moves = jnp.abs(denominator) > _rounding(h.dtype) * size
        load = (left @ x)[None] + 1j * omegas[:, None, None] * (resisted @ x)[None]
        answer = jnp.where(moves, -1 / jnp.where(moves, denominator, 1), 0)[:, None] * load
        parts = jnp.stack([answer.real @ x.T, answer.imag @ x.T], axis=2)
        return jax.vmap(jax.vmap(jax.vmap(unravel)))(parts)

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


def _tensors_of(args: _Args, method: str | None) -> Float[Array, "2 frequencies 3 3"]:
    """By the method given, or the one that suits."""
    tissue, energy, *_ = args
    large = ravel_pytree(tissue.configuration)[0].size > DENSE
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
                "which vertices without a cell in common do not feel each other, and outside of jax.jit, "
                'jax.vmap and jax.grad: pass method="dense".'
            )
    return _tensors(*args)


def _sparse_motions(args: _Args) -> PyTree[Array] | None:
    """As `_Oscillation.solve`, by a sparse factorisation for each frequency; None if that cannot be."""
    tissue, energy, dissipation, omegas = args
    landscapes = Landscape(tissue, energy), dissipation_landscape(tissue, dissipation)
    found = [sparse_hessian(landscape) for landscape in landscapes]
    if any(matrix is None for matrix in found):
        return None
    free = np.flatnonzero(np.asarray(ravel_pytree(movable(tissue))[0]))
    stiff, viscous = (matrix[free][:, free] for matrix in found if matrix is not None)
    left, resisted = (np.asarray(_loads(landscape), float)[:, free] for landscape in landscapes)
    # What nothing holds gets a support so weak that no modulus feels it: moduli are stationary in motions, so
    # the error is of second order.
    sizes = [float(np.abs(matrix.diagonal()).mean()) for matrix in (stiff, viscous)]
    parts = np.zeros((omegas.size, 3, 2, ravel_pytree(tissue.configuration)[0].size))
    for i, omega in enumerate(np.asarray(omegas, float)):
        support = diags_array(np.full(free.size, 1e-10 * (sizes[0] + omega * sizes[1])))
        # At rest everything is real.
        rate = 1j * omega if omega else 0.0
        answer = -factorised(stiff + rate * viscous + support).solve((left + rate * resisted).T).T
        parts[i, :, 0, free], parts[i, :, 1, free] = answer.real.T, answer.imag.T
    unravel = ravel_pytree(tissue.configuration)[1]
    return jax.vmap(jax.vmap(jax.vmap(unravel)))(jnp.asarray(parts, tissue.vertices.dtype))


@eqx.filter_jit
def _loads(landscape: Landscape) -> Float[Array, "3 dofs"]:
    """The forces that affine strains, or rates of strain, leave."""
    left = jax.vmap(landscape.curvature())(voigt_basis(landscape.tissue))[1]
    return jax.vmap(lambda x: ravel_pytree(x)[0])(left)


@eqx.filter_jit
def _tensors_along(args: _Args, motions: PyTree[Array]) -> Float[Array, "2 frequencies 3 3"]:
    return _Oscillation().value(args, motions)


_FALLING = 1e-6


def _rounding(dtype: jnp.dtype) -> float:
    """What is nothing but rounding, next to 1."""
    return 1e3 * float(jnp.finfo(dtype).eps)


def _simultaneously_diagonal(
    hessian: Float[Array, "dofs dofs"], resistance: Float[Array, "dofs dofs"]
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"], Float[Array, "dofs dofs"]]:
    r"""Numbers h and g, and columns X with $X^T H X = h$ and $X^T \Gamma X = g$, both diagonal.

    Either matrix may have null vectors. Common ones are left out: their columns are 0. NaN if the energy
    falls along a motion that nothing resists.
    """
    scale = lambda a: jnp.maximum(jnp.max(jnp.sum(jnp.abs(a), axis=1)), jnp.finfo(a.dtype).tiny)
    of_h, of_g = scale(hessian), scale(resistance)
    sizes, vectors = jnp.linalg.eigh(hessian / of_h + resistance / of_g)
    kept = sizes > _rounding(sizes.dtype) * sizes[-1]
    # (The Hessian of a tissue that is fluid has small eigenvalues of any sign.)
    falls = sizes[0] < -_FALLING * sizes[-1]
    whitening = vectors * jnp.where(kept, 1 / jnp.sqrt(jnp.where(kept, sizes, 1)), 0)
    g, rotation = jnp.linalg.eigh(whitening.T @ (resistance / of_g) @ whitening)
    x = jnp.where(falls, jnp.nan, whitening @ rotation)
    # Where g is nearly 1, h is what is left of 1, and known better from H itself.
    h = jnp.sum(x * (hessian @ x), axis=0)
    return h, of_g * g, x


@eqx.filter_jit
def _tensors(
    tissue: Tissue,
    energy: AbstractEnergy,
    dissipation: AbstractDissipation,
    omegas: Float[Array, " frequencies"],
) -> Float[Array, "2 frequencies 3 3"]:
    # (A stress adds to the modulus of a change of area only, and shear is without.)
    return stationary((tissue, energy, dissipation, omegas), _Oscillation())
