"""The Hessian of an energy, dense or sparse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree
from scipy import sparse
from scipy.sparse.linalg import splu

from vertax.mechanics._landscape import Landscape
from vertax.mesh import Tissue

# A dense eigenproblem of that size takes a fraction of a second.
DENSE = 800
# As many products at a time as memory has room for in a large tissue.
_BATCH = 64


def movable(tissue: Tissue) -> PyTree[Bool[Array, "..."]]:
    """Which entries of the configuration can move: not those of pinned vertices and of straight edges."""
    free = jnp.ones(tissue.vertices.shape, bool)
    if tissue.pinned is not None:
        free &= ~tissue.pinned[:, None]
    return free if tissue.arcs is None else (free, tissue.is_arc)


def flat_hessian(landscape: Landscape) -> Callable[[Float[Array, " dofs"]], Float[Array, " dofs"]]:
    """Products of the second derivatives by the configuration with flat vectors."""
    curvature, (still, y) = landscape.curvature(), landscape.still
    unravel = ravel_pytree(y)[1]
    return lambda v: ravel_pytree(curvature((still, unravel(v)))[1])[0]


def hessian_products(
    landscape: Landscape, vectors: Float[Array, "vectors dofs"]
) -> Float[Array, "vectors dofs"]:
    """Products of the second derivatives by the configuration with rows of a matrix."""
    return jax.lax.map(flat_hessian(landscape), vectors, batch_size=_BATCH)


def dense_hessian(landscape: Landscape) -> Float[Array, "dofs dofs"]:
    """All second derivatives by the configuration; rows of what cannot move are 0."""
    tissue = landscape.tissue
    size = ravel_pytree(tissue.configuration)[0].size
    matrix = hessian_products(landscape, jnp.eye(size, dtype=tissue.vertices.dtype))
    return 0.5 * (matrix + matrix.T)


def sparse_hessian(landscape: Landscape) -> sparse.csr_array | None:
    """All of the Hessian of a local potential, from a few dozen products, for the host.

    Vertices without a cell in common do not feel each other. Those so far apart that no vertex feels two of
    them share a product (Curtis, Powell & Reid 1974, doi:10.1093/imamat/13.1.117). None if the potential
    turns out not to be local.
    """
    tissue = landscape.tissue
    owner, component = _degrees_of_freedom(tissue)
    incidence = _incidence(tissue)
    near = sparse.csr_array((incidence @ incidence.T).astype(bool))
    # (A vertex of a spare slot has no cell: with the identity it is at least its own neighbour.)
    itself = sparse.eye_array(near.indptr.size - 1, dtype=bool)
    colour = _colours(sparse.csr_array(near @ near + itself))
    seed = 2 * colour[owner] + component
    # A multiple, lest each tissue compile another program. The last one asks everything at once.
    seeds = np.zeros((32 * ((seed.max() + 1) // 32 + 1), seed.size))
    seeds[seed, np.arange(seed.size)] = 1
    seeds[-1] = probe = np.cos(np.arange(seed.size) * (np.arange(seed.size) + 0.5))
    products = np.asarray(_products(landscape, jnp.asarray(seeds, tissue.vertices.dtype)), float)
    rows, columns = sparse.csr_array(near[owner][:, owner]).nonzero()
    values = products[seed[columns], rows]
    matrix = sparse.csr_array((values, (rows, columns)), shape=(seed.size, seed.size))
    whole, size = products[-1], abs(matrix) @ np.abs(probe)
    rounding = 1e4 * float(jnp.finfo(tissue.vertices.dtype).eps)
    if np.abs(matrix @ probe - whole).max() > rounding * size.max(initial=0):
        return None
    return 0.5 * (matrix + matrix.T)


def factorised(matrix: sparse.sparray) -> Any:
    """A factorisation of a symmetric sparse matrix, with its method `solve`."""
    return splu(
        sparse.csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


_products = eqx.filter_jit(hessian_products)


def _degrees_of_freedom(
    tissue: Tissue,
) -> tuple[Int[np.ndarray, " dofs"], Int[np.ndarray, " dofs"]]:
    """Of each entry of the flat configuration the vertex or edge (counted on), and which of its numbers."""
    vertices, edges = tissue.n_vertices, tissue.n_edges if tissue.arcs is not None else 0
    owner = np.concatenate([np.repeat(np.arange(vertices), 2), vertices + np.arange(edges)])
    return owner, np.concatenate([np.tile([0, 1], vertices), np.zeros(edges, int)])


def _incidence(tissue: Tissue) -> sparse.csr_array:
    """Which cell each vertex, and each edge that may be an arc, belongs to."""
    m = tissue.topology
    of_vertices = np.asarray(m.cell).reshape(-1, 3)
    cells = np.concatenate([of_vertices[:, i] for i in range(3)])
    owners = np.tile(np.arange(tissue.n_vertices), 3)
    if tissue.arcs is not None:
        sides = np.asarray(m.edge_cells)
        cells = np.concatenate([cells, sides[:, 0], sides[:, 1]])
        owners = np.concatenate([owners, np.tile(tissue.n_vertices + np.arange(m.n_edges), 2)])
    # The exterior has no energy.
    known = cells < m.n_cells
    shape = (int(owners.max()) + 1, m.n_cells)
    return sparse.csr_array((np.ones(known.sum()), (owners[known], cells[known])), shape=shape)


def _colours(graph: sparse.csr_array) -> Int[np.ndarray, " nodes"]:
    """Colours such that neighbours differ, each as often as it can be (Luby 1986, doi:10.1137/0215074).

    Each node must be a neighbour of itself: then the open node of the highest rank is chosen, and the loops
    end.
    """
    pointers, neighbours = graph.indptr[:-1], graph.indices
    n = pointers.size
    order = np.random.default_rng(0).permutation(n)
    largest = lambda values: np.maximum.reduceat(values[neighbours], pointers)
    colour = np.full(n, -1)
    number = 0
    while (colour < 0).any():
        open_ = colour < 0
        while open_.any():
            rank = np.where(open_, order, -1)
            chosen = open_ & (rank == largest(rank))
            colour[chosen] = number
            open_ &= ~largest(chosen)
        number += 1
    return colour
