"""Laser ablation of edges and cells."""

from __future__ import annotations

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from vertax._base.announce import announced_jit
from vertax._base.checks import check_instance, check_shape
from vertax._base.indexing import take
from vertax._base.model_checks import check_spare
from vertax._base.tracing import is_concrete, tree_where
from vertax.energies import Ablated, AbstractEnergy, AbstractLocalEnergy
from vertax.mesh import Tissue
from vertax.transitions._euler_operators import merge_cells
from vertax.transitions._t1 import has_new_overlaps
from vertax.transitions._t2 import face_sides


def ablate(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    edges: ArrayLike | None = None,
    cells: ArrayLike | None = None,
) -> tuple[Tissue, Ablated]:
    """Remove the energy of ablated edges and cells.

    Ablated cells that touch become one hole with the number of one of them; the other cells and the edges
    between them become spare slots. The two outline edges at each end of a removed edge become one straight
    edge.

    ```python
    tissue, energy = vx.transitions.ablate(relaxed.tissue, energy, edges=jnp.arange(tissue.n_edges) == 7)
    recoil = vx.evolve(tissue, energy, friction, times)
    ```

    **Arguments:**

    - `tissue`: the tissue; to ablate cells it must support spare slots, see
        [`with_capacity`][vertax.Tissue.with_capacity].
    - `energy`: its energy, a sum over cells and edges.
    - `edges`, shape `(edges,)`: which edges are cut, booleans.
    - `cells`, shape `(cells,)`: which cells are ablated, booleans.

    **Returns:** the tissue, and the energy of the other cells and edges
    ([`Ablated`][vertax.energies.Ablated]).

    **Raises:**

    - `TypeError` for an energy that is not a sum over cells and edges.
    - `ValueError` for masks of the wrong length, no mask, or cells in a tissue without spare slots.
    - `RuntimeError` (an error of Equinox inside `jax.jit`) if cells that touch cannot become one hole: it
        would surround living cells or be all of a free tissue, a neighbour would have too few sides, or
        cells would overlap.
    """
    check_instance(
        "energy", energy, AbstractLocalEnergy, "a sum over cells and edges, an AbstractLocalEnergy"
    )
    if edges is None and cells is None:
        raise ValueError(
            "Argument `edges` or `cells` must be a mask of booleans, but both are None."
        )
    ablated = Ablated(cast(AbstractLocalEnergy, energy), cells, edges)
    for name, mask, size in (
        ("edges", ablated.edges, tissue.n_edges),
        ("cells", ablated.cells, tissue.n_cells),
    ):
        if mask is not None:
            remedy = f"For one of them by its number: {name}=jnp.arange({size}) == 7."
            check_shape(name, mask, (size,), remedy=remedy)
    if ablated.cells is None:
        return tissue, ablated
    check_spare(tissue)
    merged, separate = _merged(tissue, ablated.cells)
    reason = (
        "Argument `cells` must hold cells that become one hole where they touch, but two of them cannot: "
        "the hole would surround living cells or be all of a free tissue, a neighbour would have too "
        "few sides, or cells would overlap. Ablate other cells, or cut their edges."
    )
    if is_concrete(separate) and bool(separate):
        raise RuntimeError(reason)
    return eqx.error_if(merged, separate, reason), ablated


@announced_jit
def _merged(tissue: Tissue, holes: Bool[Array, " cells"]) -> tuple[Tissue, Bool[Array, ""]]:
    """Merge holes that touch; also return whether some could not be merged."""
    hole = jnp.append(holes, jnp.zeros(2, bool))  # neither the exterior nor spare slots
    edges = jnp.arange(tissue.n_edges)

    def between(tissue: Tissue) -> Bool[Array, " edges"]:
        cells = tissue.topology.edge_cells
        return jnp.all(take(hole, cells), axis=-1) & (cells[:, 0] != cells[:, 1])

    # The loop ends: each merge reduces the number of cells, and between two merges each edge is rejected at
    # most once.
    def merge(carry: tuple) -> tuple:
        tissue, rejected = carry
        edge = jnp.argmax(between(tissue) & ~rejected)
        h = take(tissue.topology.half_edge, edge)
        new = tissue.with_topology(merge_cells(tissue.topology, h, jnp.array(True)))
        valid = _is_valid_merge(new, tissue)
        return tree_where(valid, new, tissue), jnp.where(valid, False, rejected | (edges == edge))

    start = (tissue, jnp.zeros(tissue.n_edges, bool))
    unfinished = lambda carry: jnp.any(between(carry[0]) & ~carry[1])
    tissue, _ = jax.lax.while_loop(unfinished, merge, start)
    separate = jnp.any(between(tissue))
    if tissue.pinned is not None:  # removed vertices are not pinned
        pinned = tissue.pinned & tissue.topology.alive_vertices
        tissue = eqx.tree_at(lambda t: t.pinned, tissue, pinned)
    return tissue, separate


def _is_valid_merge(new: Tissue, before: Tissue) -> Bool[Array, ""]:
    """Whether after a merge all faces have enough sides, cells are disks, and nothing new overlaps."""
    m = new.topology
    sides, required = face_sides(new)
    outside = jnp.arange(m.n_faces) == m.n_cells if m.exterior else jnp.zeros(m.n_faces, bool)
    enough = (sides >= required) | ((sides == 0) & ~outside)
    valid = jnp.all(enough[: m.n_cells + m.exterior])
    if m.exterior:  # a cell that is its own neighbour would surround others
        same = m.edge_cells[:, 0] == m.edge_cells[:, 1]
        valid &= ~jnp.any(same & m.alive_edges)
    return valid & ~has_new_overlaps(new, before)
