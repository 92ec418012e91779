"""Room for cells to come."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from vertax._base.checks import check_concrete, check_whole
from vertax.mesh._topology import Topology

if TYPE_CHECKING:
    from vertax.mesh._tissue import Tissue


def with_capacity(tissue: Tissue, n_cells: int) -> Tissue:
    """See `Tissue.with_capacity`."""
    check_whole("n_cells", n_cells)
    have = tissue.n_cells
    if n_cells < have:
        raise ValueError(
            f"Argument `n_cells` must be at least {have}, the number of cells that there is room for "
            f"already, but is {n_cells}. To drop spare slots call `without_spare()` first."
        )
    m, more = tissue.topology, n_cells - have
    n_half, n_edges, n_vertices = m.n_half_edges, m.n_edges, m.n_vertices
    slot = jnp.arange(more, dtype=m.twin.dtype)[:, None]
    one = n_half + 6 * slot + jnp.arange(3, dtype=m.twin.dtype)
    other = n_half + 6 * slot + jnp.asarray([3, 5, 4], m.twin.dtype)
    # In the order of half-edges: those of the first vertex of a slot, and those of the second.
    twins = jnp.concatenate([other, one[:, jnp.asarray([0, 2, 1])]], axis=1).ravel()
    edge = n_edges + 3 * slot + jnp.asarray([0, 1, 2, 0, 2, 1], m.twin.dtype)
    # Who is out of all cells keeps so by a label that grows with the number of cells.
    cell = jnp.where(m.cell >= have, m.cell + more, m.cell)
    join = lambda a, b: jnp.concatenate([a, b.astype(a.dtype)])
    topology = _directed(
        Topology(
            join(m.twin, twins),
            join(cell, jnp.full(6 * more, n_cells + 1)),
            join(m.frame, jnp.zeros((6 * more, 2))),
            join(m.edge, edge.ravel()),
            exterior=m.exterior,
            spare=True,
        ),
        join(m.half_edge, one.ravel()),
    )
    place = jnp.broadcast_to(jnp.mean(tissue.vertices, axis=0), (2 * more, 2))
    tissue = eqx.tree_at(
        lambda t: (t.topology, t.vertices), tissue, (topology, join(tissue.vertices, place))
    )
    if tissue.pinned is not None:
        pinned = join(tissue.pinned, jnp.zeros(topology.n_vertices - n_vertices, bool))
        tissue = eqx.tree_at(lambda t: t.pinned, tissue, pinned)
    if tissue.angles is not None:
        tissue = tissue.with_angles(join(tissue.angles, jnp.zeros(3 * more)))
    return tissue


def without_spare(tissue: Tissue) -> Tissue:
    """See `Tissue.without_spare`."""
    check_concrete("without_spare", tissue)
    m = tissue.topology
    if not m.spare:
        return tissue
    cells, vertices, edges = (
        jnp.flatnonzero(alive) for alive in (m.alive, m.alive_vertices, m.alive_edges)
    )
    halves = (3 * vertices[:, None] + jnp.arange(3)).ravel()
    rank = lambda kept, size: (
        jnp.zeros(size, m.twin.dtype).at[kept].set(jnp.arange(len(kept), dtype=m.twin.dtype))
    )
    of_half = rank(halves, m.n_half_edges)
    # (The label of the exterior comes after those of the cells.)
    of_cell = rank(jnp.append(cells, m.n_cells), m.n_faces)
    topology = _directed(
        Topology(
            of_half[m.twin[halves]],
            of_cell[m.cell[halves]],
            m.frame[halves],
            rank(edges, m.n_edges)[m.edge[halves]],
            exterior=m.exterior,
        ),
        of_half[m.half_edge[edges]],
    )
    parts = lambda t: (t.topology, t.vertices)
    tissue_of = eqx.tree_at(parts, tissue, (topology, tissue.vertices[vertices]))
    if tissue.pinned is not None:
        tissue_of = eqx.tree_at(lambda t: t.pinned, tissue_of, tissue.pinned[vertices])
    return tissue_of if tissue.angles is None else tissue_of.with_angles(tissue.angles[edges])


def _directed(topology: Topology, half_edge: Int[Array, " edges"]) -> Topology:
    """The same with edges that run as these half-edges do."""
    return eqx.tree_at(lambda m: m.half_edge, topology, half_edge)
