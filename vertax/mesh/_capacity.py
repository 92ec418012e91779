"""Spare slots: memory for cells that are created later."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from vertax._base.checks import check_concrete, check_integer
from vertax._base.tracing import is_concrete
from vertax.mesh._topology import Topology


def size_class(n_cells: int) -> int:
    """The number of cells to which a tissue is padded: at most 25 % more than `n_cells`."""
    size = n_cells if n_cells < 4 else 4
    while size < n_cells:
        size = 5 * (size + 1) // 4
    return size


def with_slots(m: Topology, n_cells: int) -> Topology:
    """Add spare slots up to a capacity of `n_cells` cells."""
    check_integer("n_cells", n_cells)
    capacity = m.n_cells
    if n_cells < capacity:
        raise ValueError(
            f"Argument `n_cells` must be at least {capacity}, the capacity of the tissue, but is "
            f"{n_cells}. To remove spare slots call `without_spare()` first."
        )
    n_slots = n_cells - capacity
    # NumPy for concrete arrays, because JAX would compile for each size.
    xp = np if all(map(is_concrete, (m.twin, m.cell, m.frame, m.edge, m.half_edge))) else jnp
    slot = 6 * xp.arange(n_slots, dtype=m.twin.dtype)[:, None]
    # In each slot, half-edges 0, 1, 2 leave one vertex, and 3, 5, 4 are their twins.
    twins = m.n_half_edges + slot + xp.asarray([3, 5, 4, 0, 2, 1], m.twin.dtype)
    edges = m.n_edges + slot // 2 + xp.asarray([0, 1, 2, 0, 2, 1], m.twin.dtype)
    half_edge = m.n_half_edges + slot + xp.arange(3, dtype=m.twin.dtype)
    # The labels of the exterior and of spare slots follow those of the cells.
    cell = xp.asarray(m.cell)
    cell = xp.where(cell >= capacity, cell + n_slots, cell)
    join = lambda a, b: xp.concatenate([xp.asarray(a), b.astype(a.dtype)])
    topology = Topology(
        join(m.twin, twins.ravel()),
        join(cell, xp.full(6 * n_slots, n_cells + 1)),
        join(m.frame, xp.zeros((6 * n_slots, 2))),
        join(m.edge, edges.ravel()),
        exterior=m.exterior,
        spare=True,
    )
    return _directed(topology, jnp.asarray(join(m.half_edge, half_edge.ravel())))


def without_slots(
    m: Topology,
) -> tuple[Topology, Int[Array, " vertices"], Int[Array, " edges"]]:
    """Remove spare slots; also return the old indices of the remaining vertices and edges."""
    check_concrete("without_spare", m)
    cells, vertices, edges = (
        jnp.flatnonzero(alive) for alive in (m.alive, m.alive_vertices, m.alive_edges)
    )
    half_edges = (3 * vertices[:, None] + jnp.arange(3)).ravel()

    def rank(kept: Array, size: int) -> Array:
        numbers = jnp.arange(len(kept), dtype=m.twin.dtype)
        return jnp.zeros(size, m.twin.dtype).at[kept].set(numbers)

    of_half = rank(half_edges, m.n_half_edges)
    # (The label of the exterior follows those of the cells.)
    of_cell = rank(jnp.append(cells, m.n_cells), m.n_faces)
    topology = Topology(
        of_half[m.twin[half_edges]],
        of_cell[m.cell[half_edges]],
        m.frame[half_edges],
        rank(edges, m.n_edges)[m.edge[half_edges]],
        exterior=m.exterior,
    )
    return _directed(topology, of_half[m.half_edge[edges]]), vertices, edges


def _directed(topology: Topology, half_edge: Int[Array, " edges"]) -> Topology:
    """The topology with `half_edge` replaced, which gives edges their direction."""
    return eqx.tree_at(lambda m: m.half_edge, topology, half_edge)
