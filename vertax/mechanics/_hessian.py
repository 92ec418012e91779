"""The Hessian of an energy, dense or sparse."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree
from scipy import sparse

from vertax._base.announce import announced_jit
from vertax.mechanics._landscape import Landscape
from vertax.mesh import Tissue

# Degrees of freedom up to which dense methods are the default: an eigenproblem takes less than a second.
MAX_DENSE_SIZE = 800
# Hessian products per batch, limited by the memory of a large tissue.
_BATCH = 64


def movable(tissue: Tissue) -> PyTree[Bool[Array, "..."]]:
    """A mask of the entries of the configuration that move: no pinned or spare vertex, no straight edge."""
    free = jnp.ones(tissue.vertices.shape, bool)
    if tissue.held is not None:
        free &= ~tissue.held[:, None]
    return free if tissue.arcs is None else (free, tissue.is_arc)


def zero_threshold(values: np.ndarray, tolerance: float | None, default: float) -> float:
    """Up to which absolute value a number counts as 0, as a fraction `tolerance` of the largest one.

    By default the fraction is `default`, or 100 times the rounding of the data type if that is larger.
    """
    rounding = 100 * float(np.finfo(values.dtype).eps)
    fraction = max(default, rounding) if tolerance is None else tolerance
    return fraction * float(np.abs(values).max(initial=0))


def flat_hessian(landscape: Landscape) -> Callable[[Float[Array, " dofs"]], Float[Array, " dofs"]]:
    """The product of the Hessian with a flat vector, v -> H v."""
    product, (no_strain, y) = landscape.hessian_product(), landscape.zero
    unravel = ravel_pytree(y)[1]
    return lambda v: ravel_pytree(product((no_strain, unravel(v)))[1])[0]


def hessian_products(
    landscape: Landscape, vectors: Float[Array, "vectors dofs"]
) -> Float[Array, "vectors dofs"]:
    """Products of the Hessian with the rows of a matrix."""
    return jax.lax.map(flat_hessian(landscape), vectors, batch_size=_BATCH)


def dense_hessian(landscape: Landscape) -> Float[Array, "dofs dofs"]:
    """The Hessian as a matrix; rows of entries that cannot move are 0."""
    tissue = landscape.tissue
    size = ravel_pytree(tissue.configuration)[0].size
    matrix = hessian_products(landscape, jnp.eye(size, dtype=tissue.vertices.dtype))
    return 0.5 * (matrix + matrix.T)


def sparse_hessian(landscape: Landscape) -> sparse.csr_array | None:
    """The Hessian of a local potential from a few dozen products; it runs on the host.

    H_ij = 0 for vertices i, j without a common cell. Columns without a common nonzero row share a product:
    the graph of second neighbours is coloured, one product per colour (Curtis, Powell & Reid 1974,
    doi:10.1093/imamat/13.1.117). None if a test product shows that the potential is not local.
    """
    tissue = landscape.tissue
    owner, component = _degrees_of_freedom(tissue)
    incidence = _incidence(tissue)
    neighbours = sparse.csr_array((incidence @ incidence.T).astype(bool))
    # (The vertices of a spare slot have no cell. The identity makes each vertex its own neighbour.)
    identity = sparse.eye_array(neighbours.indptr.size - 1, dtype=bool)
    colour = _colours(sparse.csr_array(neighbours @ neighbours + identity))
    seed = 2 * colour[owner] + component
    # Rounded up to a multiple of 32 rows, so that few shapes are compiled. The last row is the test product.
    seeds = np.zeros((32 * ((seed.max() + 1) // 32 + 1), seed.size))
    seeds[seed, np.arange(seed.size)] = 1
    seeds[-1] = probe = np.cos(np.arange(seed.size) * (np.arange(seed.size) + 0.5))
    products = np.asarray(_products(landscape, jnp.asarray(seeds, tissue.vertices.dtype)), float)
    rows, columns = sparse.csr_array(neighbours[owner][:, owner]).nonzero()
    values = products[seed[columns], rows]
    matrix = sparse.csr_array((values, (rows, columns)), shape=(seed.size, seed.size))
    expected, size = products[-1], abs(matrix) @ np.abs(probe)
    rounding = 1e4 * float(jnp.finfo(tissue.vertices.dtype).eps)
    if np.abs(matrix @ probe - expected).max() > rounding * size.max(initial=0):
        return None
    return 0.5 * (matrix + matrix.T)


_products = announced_jit(hessian_products)


def _degrees_of_freedom(
    tissue: Tissue,
) -> tuple[Int[np.ndarray, " dofs"], Int[np.ndarray, " dofs"]]:
    """For each entry of the flat configuration: index of its vertex, or of its edge plus the number of
    vertices, and its component."""
    vertices, edges = tissue.n_vertices, tissue.n_edges if tissue.arcs is not None else 0
    owner = np.concatenate([np.repeat(np.arange(vertices), 2), vertices + np.arange(edges)])
    return owner, np.concatenate([np.tile([0, 1], vertices), np.zeros(edges, int)])


def _incidence(tissue: Tissue) -> sparse.csr_array:
    """The incidence matrix of cells with vertices and, in tissues with arcs, edges."""
    m = tissue.topology
    of_vertices = np.asarray(m.cell).reshape(-1, 3)
    cells = np.concatenate([of_vertices[:, i] for i in range(3)])
    owners = np.tile(np.arange(tissue.n_vertices), 3)
    if tissue.arcs is not None:
        sides = np.asarray(m.edge_cells)
        cells = np.concatenate([cells, sides[:, 0], sides[:, 1]])
        owners = np.concatenate([owners, np.tile(tissue.n_vertices + np.arange(m.n_edges), 2)])
    # The exterior has no energy.
    inside = cells < m.n_cells
    shape = (int(owners.max()) + 1, m.n_cells)
    return sparse.csr_array((np.ones(inside.sum()), (owners[inside], cells[inside])), shape=shape)


def _colours(graph: sparse.csr_array) -> Int[np.ndarray, " nodes"]:
    """A graph colouring by maximal independent sets (Luby 1986, doi:10.1137/0215074).

    Each node must be a neighbour of itself: then the remaining node of the highest rank is always chosen, and
    the loops end.
    """
    pointers, neighbours = graph.indptr[:-1], graph.indices
    n = pointers.size
    order = np.random.default_rng(0).permutation(n)
    largest = lambda values: np.maximum.reduceat(values[neighbours], pointers)
    colour = np.full(n, -1)
    number = 0
    while (colour < 0).any():
        candidates = colour < 0
        while candidates.any():
            rank = np.where(candidates, order, -1)
            chosen = candidates & (rank == largest(rank))
            colour[chosen] = number
            candidates &= ~largest(chosen)
        number += 1
    return colour
