"""Vibrational modes: eigenvalues and eigenvectors of the Hessian."""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree
from scipy.sparse import diags_array
from scipy.sparse.linalg import LinearOperator, eigsh

from vertax._base.announce import announced_jit
from vertax._base.checks import (
    as_float64,
    check_choice,
    check_concrete,
    check_integer,
    check_number,
)
from vertax._base.model_checks import check_planar
from vertax._base.sparse_normal import factorised
from vertax._base.tracing import is_concrete, traced
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.mechanics._arguments import check_system
from vertax.mechanics._hessian import (
    MAX_DENSE_SIZE,
    dense_hessian,
    flat_hessian,
    movable,
    sparse_hessian,
    zero_threshold,
)
from vertax.mechanics._landscape import Landscape, stationary
from vertax.mesh import Tissue

# Eigenvalues up to this fraction of the largest one count as 0, see `zero_threshold`.
_ZERO = 1e-8


class Modes(eqx.Module):
    """Modes of a tissue at rest, the softest first."""

    values: Float[Array, " modes"]
    """Eigenvalues of the Hessian, energy per length squared. Differentiable, if they are distinct."""
    vectors: Any
    """Unit eigenvectors as changes of the configuration (with arcs a pair); not differentiated."""
    n_movable: Int[Array, ""]
    """Number of vertices that move: neither pinned nor spare."""

    @property
    def displacements(self) -> Float[Array, "modes vertices 2"]:
        """Displacements of the vertices."""
        return self.vectors[0] if isinstance(self.vectors, tuple) else self.vectors

    @property
    def participation_ratios(self) -> Float[Array, " modes"]:
        r"""Participation ratio of each mode, $(\sum_v |u_v|^2)^2 / (V \sum_v |u_v|^4)$ (Bell & Dean 1970,
        doi:10.1039/DF9705000055).

        It is 1 if all $V$ vertices that are neither pinned nor spare move by the same distance, and $1/V$ if
        one vertex moves alone.
        """
        squared = jnp.sum(self.displacements**2, axis=-1)
        return jnp.sum(squared, axis=-1) ** 2 / (self.n_movable * jnp.sum(squared**2, axis=-1))


def modes(
    tissue: Tissue,
    energy: AbstractEnergy,
    k: int,
    *,
    method: Literal["dense", "sparse"] | None = None,
) -> Modes:
    r"""The $k$ softest modes of a tissue at rest, $H u = \lambda u$ with the Hessian $H$ of the energy.

    Rigid motions are included: in a periodic tissue two translations with the eigenvalue 0.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `k`: number of modes.
    - `method`: `"dense"` computes all eigenvalues of the matrix, and works under `jax.jit`, `jax.vmap` and
        `jax.grad`. `"sparse"` computes the eigenvalues closest to 0 by ARPACK with one sparse factorisation,
        on the host: for local energies (see [`AbstractLocalEnergy`][vertax.AbstractLocalEnergy]) and large
        tissues. It is the default for local energies, tissues of more than about 200 cells, and arrays that
        are not traced.

    **Returns:** [`Modes`][vertax.mechanics.Modes].

    **Raises:**

    - `ValueError` for more modes than degrees of freedom that move, another method, or a tissue on a surface.
    - `TypeError` if `tissue` or `energy` is an object of another class, and for `"sparse"` with an energy
        that is not local, or inside `jax.jit`.
    """
    check_system(tissue, energy)
    check_planar("modes", tissue)
    check_integer("k", k, at_least=1)
    check_choice("method", method, (None, "dense", "sparse"))
    size = ravel_pytree(tissue.configuration)[0].size
    is_eager = all(map(is_concrete, jax.tree.leaves((tissue, energy))))
    n_free = int(ravel_pytree(movable(tissue))[0].sum()) if is_eager else size
    if k > n_free:
        raise ValueError(
            f"Argument `k` must be at most the number of degrees of freedom that move, {n_free}, but is {k}."
        )
    can_be_sparse = is_eager and isinstance(energy, AbstractLocalEnergy)
    if method == "sparse" and not can_be_sparse:
        raise TypeError(
            'Argument `method` can be "sparse" only for an AbstractLocalEnergy and outside of jax.jit, '
            'jax.vmap and jax.grad: pass method="dense".'
        )
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    sparse = (
        can_be_sparse and size > max(MAX_DENSE_SIZE, 4 * k)
        if method is None
        else method == "sparse"
    )
    if sparse and isinstance(energy, AbstractLocalEnergy):
        vectors = jnp.asarray(
            _soft_eigenvectors(Landscape(tissue, energy), k), tissue.vertices.dtype
        )
        return _modes_along(tissue, energy, vectors)
    return _dense_modes(tissue, energy, k)


def spectrum(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " modes"]:
    """All eigenvalues of the Hessian, ascending: one for each degree of freedom.

    Pinned vertices and the angles of straight edges are left out; therefore the arrays must not be traced.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.

    **Returns:** the eigenvalues, energy per length squared.

    **Raises:**

    - `TypeError` inside `jax.jit`, and if `tissue` or `energy` is an object of another class.
    - `ValueError` for a tissue on a surface.
    """
    check_system(tissue, energy)
    check_planar("the spectrum", tissue)
    check_concrete("spectrum", tissue, energy)
    matrix = np.asarray(_dense(Landscape(*traced((tissue, energy), tissue.vertices.dtype))))
    free = np.asarray(ravel_pytree(movable(tissue))[0])
    return jnp.asarray(np.linalg.eigvalsh(matrix[np.ix_(free, free)]))


def zero_modes(tissue: Tissue, energy: AbstractEnergy, *, tolerance: float | None = None) -> int:
    """Number of modes without stiffness, rigid motions included.

    A rigid periodic tissue has 2, the translations.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy of which the tissue is at a minimum.
    - `tolerance`: an eigenvalue counts as 0 if it is at most this fraction of the largest one; by default
        1e-8, or 100 times the rounding of the data type if that is larger.

    **Returns:** their number.

    **Raises:** as `spectrum`.
    """
    if tolerance is not None:
        check_number("tolerance", tolerance, above=0)
    values = np.abs(np.asarray(spectrum(tissue, energy)))
    return int(np.sum(values <= zero_threshold(values, tolerance, _ZERO)))


def density_of_states(
    values: Float[Array, " modes"], bins: int = 40, *, tolerance: float | None = None
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    r"""Density of states $D(\omega)$ over the frequencies $\omega = \sqrt\lambda$.

    **Arguments:**

    - `values`: all eigenvalues, see [`spectrum`][vertax.mechanics.spectrum].
    - `bins`: number of bins, from 0 to the largest frequency.
    - `tolerance`: eigenvalues of at most this fraction of the largest one are zero modes, and left out; by
        default as for [`zero_modes`][vertax.mechanics.zero_modes].

    **Returns:** the centre of each bin, and the fraction of all modes per unit of frequency in it. Its
        integral is the fraction of modes that are not zero modes.

    **Raises:**

    - `ValueError` for eigenvalues that are not finite or not a list, or a number of bins below 1.
    """
    check_integer("bins", bins, at_least=1)
    eigenvalues = as_float64("values", values)
    if eigenvalues.ndim != 1 or eigenvalues.size == 0:
        raise ValueError(
            f"Argument `values` must be one list of eigenvalues, but its shape is {eigenvalues.shape}."
        )
    if tolerance is not None:
        check_number("tolerance", tolerance, above=0)
    threshold = zero_threshold(np.asarray(values), tolerance, _ZERO)
    frequencies = np.sqrt(eigenvalues[eigenvalues > threshold])
    counts, edges = np.histogram(frequencies, bins, (0, frequencies.max(initial=0) or 1))
    return 0.5 * (edges[1:] + edges[:-1]), counts / (eigenvalues.size * np.diff(edges))


class _Spectrum(eqx.Module):
    """Eigenvalues as stationary values of the quadratic form."""

    k: int = eqx.field(static=True)

    def solve(self, args: tuple[Tissue, AbstractEnergy]) -> Float[Array, "modes dofs"]:
        tissue, energy = args
        matrix = dense_hessian(Landscape(tissue, energy))
        # Shift the eigenvalues of entries that cannot move above all others.
        fixed = ~ravel_pytree(movable(tissue))[0]
        shift = 2 * jnp.max(jnp.sum(jnp.abs(matrix), axis=1)) + 1
        _, vectors = jnp.linalg.eigh(matrix + jnp.diag(jnp.where(fixed, shift, 0)))
        return vectors[:, : self.k].T

    def value(
        self, args: tuple[Tissue, AbstractEnergy], solution: Float[Array, "modes dofs"]
    ) -> Float[Array, " modes"]:
        return _quotients(*args, solution)


def _quotients(
    tissue: Tissue, energy: AbstractEnergy, vectors: Float[Array, "modes dofs"]
) -> Float[Array, " modes"]:
    product = flat_hessian(Landscape(tissue, energy))
    return jax.vmap(lambda v: jnp.sum(v * product(v)))(vectors)


_dense = announced_jit(dense_hessian)


@announced_jit
def _dense_modes(tissue: Tissue, energy: AbstractEnergy, k: int) -> Modes:
    system = _Spectrum(k)
    args = (tissue, energy)
    vectors = jax.lax.stop_gradient(system.solve(_constant(args)))
    return Modes(stationary(args, system), _unravelled(tissue, vectors), _n_movable(tissue))


@announced_jit
def _modes_along(
    tissue: Tissue, energy: AbstractEnergy, vectors: Float[Array, "modes dofs"]
) -> Modes:
    values = _quotients(tissue, energy, vectors)
    return Modes(values, _unravelled(tissue, vectors), _n_movable(tissue))


def _n_movable(tissue: Tissue) -> Int[Array, ""]:
    return jnp.sum(jax.tree.leaves(movable(tissue))[0][:, 0])


def _constant(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _unravelled(
    tissue: Tissue, vectors: Float[Array, "modes dofs"]
) -> PyTree[Float[Array, "modes ..."]]:
    return jax.vmap(ravel_pytree(tissue.configuration)[1])(vectors)


def _soft_eigenvectors(landscape: Landscape, k: int) -> Float[np.ndarray, "modes dofs"]:
    """The eigenvectors of the eigenvalues closest to 0, by shift and invert."""
    tissue = landscape.tissue
    free = np.flatnonzero(np.asarray(ravel_pytree(movable(tissue))[0]))
    hessian = sparse_hessian(landscape)
    if hessian is None:
        raise TypeError(
            "Argument `energy` must be local, but vertices without a common cell interact, although it is an "
            'AbstractLocalEnergy. Pass method="dense".'
        )
    matrix = hessian[free][:, free]
    # A shift below 0 that is smaller than differences of eigenvalues, and makes zero modes invertible.
    shift = 1e-7 * matrix.diagonal().mean()
    factors = factorised(matrix + diags_array(np.full(free.size, shift)))
    # (`LinearOperator(...)` returns an object of a subclass, which type checkers cannot infer.)
    linear: Any = LinearOperator
    inverse = linear(matrix.shape, matvec=factors.solve, dtype=float)
    start = np.cos(np.arange(free.size) * (np.arange(free.size) + 0.5))
    values, vectors = eigsh(matrix, k, sigma=-shift, OPinv=inverse, v0=start)
    modes = np.zeros((k, ravel_pytree(tissue.configuration)[0].size))
    modes[:, free] = vectors[:, np.argsort(values)].T
    return modes
