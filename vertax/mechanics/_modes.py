"""Vibrational modes: eigenvalues and eigenvectors of the Hessian."""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree
from scipy.sparse import diags_array
from scipy.sparse.linalg import LinearOperator, eigsh

from vertax._base.checks import as_float64, check_concrete, check_integer, check_number
from vertax._base.tracing import is_concrete, traced
from vertax.energies import AbstractEnergy, AbstractLocalEnergy
from vertax.mechanics._arguments import check_system
from vertax.mechanics._hessian import (
    DENSE,
    dense_hessian,
    factorised,
    flat_hessian,
    movable,
    sparse_hessian,
)
from vertax.mechanics._landscape import Landscape, stationary
from vertax.mesh import Tissue


class Modes(eqx.Module):
    """Modes of a tissue at rest, the softest first."""

    values: Float[Array, " modes"]
    """Eigenvalues of the Hessian, energy per length squared. Differentiable, if they are distinct."""
    vectors: PyTree[Float[Array, "modes ..."]]
    """Unit eigenvectors as changes of the configuration (with arcs a pair); taken for constants."""

    @property
    def displacements(self) -> Float[Array, "modes vertices 2"]:
        """How vertices move."""
        return self.vectors[0] if isinstance(self.vectors, tuple) else self.vectors

    @property
    def participation_ratios(self) -> Float[Array, " modes"]:
        r"""Which share of the vertices takes part, $(\sum_v |u_v|^2)^2 / (V \sum_v |u_v|^4)$.

        1 if all move alike, and one over their number if one moves alone (Bell & Dean 1970,
        doi:10.1039/DF9705000055).
        """
        squared = jnp.sum(self.displacements**2, axis=-1)
        return jnp.sum(squared, axis=-1) ** 2 / (squared.shape[-1] * jnp.sum(squared**2, axis=-1))


def modes(
    tissue: Tissue,
    energy: AbstractEnergy,
    k: int,
    *,
    method: Literal["dense", "sparse"] | None = None,
) -> Modes:
    r"""The $k$ softest modes of a tissue at rest, $H u = \lambda u$ with the Hessian $H$ of the energy.

    The motions of the whole that cost nothing are among them: in a periodic tissue two, of the
    eigenvalue 0.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy that it is at rest under.
    - `k`: how many modes.
    - `method`: `"dense"` takes the whole spectrum of the matrix, and works under `jax.jit`, `jax.vmap` and
        `jax.grad`. `"sparse"` takes the eigenvalues next to 0 by ARPACK with one sparse factorisation,
        on the host: for energies that are local (see
        [`AbstractLocalEnergy`][vertax.AbstractLocalEnergy]) and large tissues. By default that, if the
        tissue has more than 200 cells or so and nothing is traced.

    **Returns:** [`Modes`][vertax.mechanics.Modes].

    **Raises:**

    - `ValueError` for more modes than degrees of freedom, or another method.
    - `TypeError` for what is no tissue or no energy, and for `"sparse"` with an energy that is not local,
        or inside `jax.jit`.
    """
    check_system(tissue, energy)
    check_integer("k", k, at_least=1)
    if method not in (None, "dense", "sparse"):
        raise ValueError(f'Argument `method` must be "dense" or "sparse", but is {method!r}.')
    size = ravel_pytree(tissue.configuration)[0].size
    if k > size:
        raise ValueError(
            f"Argument `k` must be at most the number of degrees of freedom, {size}, but is {k}."
        )
    known = all(map(is_concrete, jax.tree.leaves((tissue, energy))))
    possible = known and isinstance(energy, AbstractLocalEnergy)
    if method == "sparse" and not possible:
        raise TypeError(
            'Argument `method` can be "sparse" only for an AbstractLocalEnergy and outside of jax.jit, '
            'jax.vmap and jax.grad: pass method="dense".'
        )
    tissue, energy = traced((tissue, energy), tissue.vertices.dtype)
    sparse = possible and size > max(DENSE, 4 * k) if method is None else method == "sparse"
    if sparse and isinstance(energy, AbstractLocalEnergy):
        vectors = jnp.asarray(_softest(Landscape(tissue, energy), k), tissue.vertices.dtype)
        return _modes_along(tissue, energy, vectors)
    return _dense_modes(tissue, energy, k)


def spectrum(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " modes"]:
    """All eigenvalues of the Hessian, ascending: one for each degree of freedom.

    Those of pinned vertices and straight edges are left out, and for that the arrays must not be traced.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy that it is at rest under.

    **Returns:** the eigenvalues, energy per length squared.

    **Raises:**

    - `TypeError` inside `jax.jit`, and for what is no tissue or no energy.
    """
    check_system(tissue, energy)
    check_concrete("spectrum", tissue, energy)
    matrix = np.asarray(_dense(Landscape(*traced((tissue, energy), tissue.vertices.dtype))))
    free = np.asarray(ravel_pytree(movable(tissue))[0])
    return jnp.asarray(np.linalg.eigvalsh(matrix[np.ix_(free, free)]))


def zero_modes(tissue: Tissue, energy: AbstractEnergy, *, tolerance: float = 1e-8) -> int:
    """Number of modes that cost nothing, motions of the whole among them.

    A periodic tissue has 2 if it is rigid.

    **Arguments:**

    - `tissue`: a tissue at rest.
    - `energy`: the energy that it is at rest under.
    - `tolerance`: an eigenvalue counts as 0 if it is that much smaller than the largest one.

    **Returns:** their number.

    **Raises:** as `spectrum`.
    """
    check_number("tolerance", tolerance, above=0)
    values = np.abs(np.asarray(spectrum(tissue, energy)))
    return int(np.sum(values <= tolerance * values.max()))


def density_of_states(
    values: Float[Array, " modes"], bins: int = 40, *, tolerance: float = 1e-8
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    r"""Density of states $D(\omega)$ over the frequencies $\omega = \sqrt\lambda$.

    **Arguments:**

    - `values`: a whole [`spectrum`][vertax.mechanics.spectrum].
    - `bins`: number of bins, from 0 to the largest frequency.
    - `tolerance`: eigenvalues that are that much smaller than the largest one are zero modes, and left out.

    **Returns:** the middle of each bin, and the share of all modes per frequency in it: its integral is the
        share of the modes that are no zero modes.

    **Raises:**

    - `ValueError` for what is no list of finite eigenvalues, or no bins.
    """
    check_integer("bins", bins, at_least=1)
    found = as_float64("values", values)
    if found.ndim != 1 or found.size == 0:
        raise ValueError(
            f"Argument `values` must be one list of eigenvalues, but its shape is {found.shape}."
        )
    check_number("tolerance", tolerance, above=0)
    frequencies = np.sqrt(found[found > tolerance * np.abs(found).max()])
    counts, edges = np.histogram(frequencies, bins, (0, frequencies.max(initial=0) or 1))
    return 0.5 * (edges[1:] + edges[:-1]), counts / (found.size * np.diff(edges))


class _Spectrum(eqx.Module):
    """Eigenvalues as stationary values of the quadratic form."""

    k: int = eqx.field(static=True)

    def solve(self, args: tuple[Tissue, AbstractEnergy]) -> Float[Array, "modes dofs"]:
        tissue, energy = args
        matrix = dense_hessian(Landscape(tissue, energy))
        # What cannot move comes last.
        held = ~ravel_pytree(movable(tissue))[0]
        above = 2 * jnp.max(jnp.sum(jnp.abs(matrix), axis=1)) + 1
        _, vectors = jnp.linalg.eigh(matrix + jnp.diag(jnp.where(held, above, 0)))
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


_dense = eqx.filter_jit(dense_hessian)


@eqx.filter_jit
def _dense_modes(tissue: Tissue, energy: AbstractEnergy, k: int) -> Modes:
    system = _Spectrum(k)
    args = (tissue, energy)
    vectors = jax.lax.stop_gradient(system.solve(_constant(args)))
    return Modes(stationary(args, system), _unravelled(tissue, vectors))


@eqx.filter_jit
def _modes_along(
    tissue: Tissue, energy: AbstractEnergy, vectors: Float[Array, "modes dofs"]
) -> Modes:
    return Modes(_quotients(tissue, energy, vectors), _unravelled(tissue, vectors))


def _constant(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _unravelled(
    tissue: Tissue, vectors: Float[Array, "modes dofs"]
) -> PyTree[Float[Array, "modes ..."]]:
    return jax.vmap(ravel_pytree(tissue.configuration)[1])(vectors)


def _softest(landscape: Landscape, k: int) -> Float[np.ndarray, "modes dofs"]:
    """The eigenvectors of the eigenvalues next to 0, by shift and invert."""
    tissue = landscape.tissue
    free = np.flatnonzero(np.asarray(ravel_pytree(movable(tissue))[0]))
    found = sparse_hessian(landscape)
    if found is None:
        raise TypeError(
            "Argument `energy` says that it is local, but vertices without a cell in common feel each other: "
            'pass method="dense".'
        )
    matrix = found[free][:, free]
    # So little below 0 that it changes no order, and far enough that zero modes can be inverted.
    shift = 1e-7 * matrix.diagonal().mean()
    factors = factorised(matrix + diags_array(np.full(free.size, shift)))
    # Its constructor makes one of a class that type checkers do not see.
    linear: Any = LinearOperator
    inverse = linear(matrix.shape, matvec=factors.solve, dtype=float)
    start = np.cos(np.arange(free.size) * (np.arange(free.size) + 0.5))
    values, vectors = eigsh(matrix, k, sigma=-shift, OPinv=inverse, v0=start)
    found = np.zeros((k, ravel_pytree(tissue.configuration)[0].size))
    found[:, free] = vectors[:, np.argsort(values)].T
    return found
