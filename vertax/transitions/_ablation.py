"""Ablation: a laser cuts edges and kills cells."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from vertax._base.checks import describe
from vertax._base.tracing import is_concrete, tree_where
from vertax.energies import Ablated, AbstractEnergy, AbstractLocalEnergy
from vertax.mesh import Tissue
from vertax.mesh._euler_operators import merge_cells
from vertax.mesh._topology import take
from vertax.transitions._t1 import has_new_overlaps
from vertax.transitions._t2 import face_sides


def ablate(
    tissue: Tissue,
    energy: AbstractEnergy,
    *,
    edges: ArrayLike | None = None,
    cells: ArrayLike | None = None,
) -> tuple[Tissue, Ablated]:
    """Cut edges, which have no tension then, and make cells a hole, which has no energy.

    Ablated cells that touch become one hole, with the number of one of them, and what was between them spare
    slots; where their common edge met the outline of the hole that is straight then.

    ```python
    tissue, energy = vx.transitions.ablate(relaxed.tissue, energy, edges=jnp.arange(tissue.n_edges) == 7)
    recoil = vx.evolve(tissue, energy, friction, times)
    ```

    **Arguments:**

    - `tissue`: the tissue; if cells are to be ablated, one with a place for spare slots, see
        [`with_capacity`][vertax.Tissue.with_capacity].
    - `energy`: its energy, a sum over cells and edges.
    - `edges`, shape `(edges,)`: which edges are cut, booleans.
    - `cells`, shape `(cells,)`: which cells are killed, booleans.

    **Returns:** the tissue, and the energy of what is left, [`Ablated`][vertax.energies.Ablated].

    **Raises:**

    - `TypeError` for an energy that is no sum over cells and edges.
    - `ValueError` for masks of the wrong length, none at all, or a tissue without a place for spare slots.
    - `RuntimeError` (of Equinox inside `jax.jit`) if cells that touch cannot become one hole: it would
        surround living cells or be all of a free tissue, a neighbour would be left with too few sides, or
        cells would overlap.
    """
    if not isinstance(energy, AbstractLocalEnergy):
        raise TypeError(
            "Argument `energy` must be a sum over cells and edges, an AbstractLocalEnergy, but is "
            f"{describe(energy)}."
        )
    if edges is None and cells is None:
        raise ValueError("Argument `edges` or `cells` must say what is ablated, but both are None.")
    left = Ablated(energy, cells, edges)
    for name, mask, size in (
        ("edges", left.edges, tissue.n_edges),
        ("cells", left.cells, tissue.n_cells),
    ):
        if mask is not None and mask.shape != (size,):
            raise ValueError(
                f"Argument `{name}` must be a mask of booleans of shape ({size},), but has {mask.shape}. "
                f"For one of them by its number: {name}=jnp.arange({size}) == 7."
            )
    if left.cells is None:
        return tissue, left
    if not tissue.topology.spare:
        raise ValueError(
            "Cells that become one hole leave spare slots behind, for which the tissue must be ready: pass "
            "tissue.with_capacity(tissue.n_cells)."
        )
    merged, separate = _merged(tissue, left.cells)
    reason = (
        "Argument `cells` must hold cells that become one hole where they touch, but two of them cannot: "
        "the hole would surround living cells or be all of a free tissue, a neighbour would be left with too "
        "few sides, or cells would overlap. Ablate other cells, or cut their edges."
    )
    if is_concrete(separate) and bool(separate):
        raise RuntimeError(reason)
    return eqx.error_if(merged, separate, reason), left


@eqx.filter_jit
def _merged(tissue: Tissue, holes: Bool[Array, " cells"]) -> tuple[Tissue, Bool[Array, ""]]:
    """The tissue with neighbouring holes made one, and whether some that touch remain separate."""
    hole = jnp.append(holes, jnp.zeros(2, bool))  # neither the exterior nor what is nowhere
    edges = jnp.arange(tissue.n_edges)

    def between(tissue: Tissue) -> Bool[Array, " edges"]:
        cells = tissue.topology.edge_cells
        return jnp.all(take(hole, cells), axis=-1) & (cells[:, 0] != cells[:, 1])

    # Each merger lowers the number of cells, and between two mergers each edge is refused at most once.
    def one(carry: tuple) -> tuple:
        tissue, refused = carry
        edge = jnp.argmax(between(tissue) & ~refused)
        h = take(tissue.topology.half_edge, edge)
        new = tissue.with_topology(merge_cells(tissue.topology, h, jnp.array(True)))
        good = _is_sound(new, tissue)
        return tree_where(good, new, tissue), jnp.where(good, False, refused | (edges == edge))

    start = (tissue, jnp.zeros(tissue.n_edges, bool))
    unfinished = lambda carry: jnp.any(between(carry[0]) & ~carry[1])
    tissue, _ = jax.lax.while_loop(unfinished, one, start)
    separate = jnp.any(between(tissue))
    if tissue.pinned is not None:  # a vertex that is gone holds nothing
        pinned = tissue.pinned & tissue.topology.alive_vertices
        tissue = eqx.tree_at(lambda t: t.pinned, tissue, pinned)
    return tissue, separate


def _is_sound(new: Tissue, before: Tissue) -> Bool[Array, ""]:
    """Whether a merger left faces with enough sides, cells that are disks, and no new overlaps."""
    m = new.topology
    sides, least = face_sides(new)
    outside = jnp.arange(m.n_faces) == m.n_cells if m.exterior else jnp.zeros(m.n_faces, bool)
    enough = (sides >= least) | ((sides == 0) & ~outside)
    sound = jnp.all(enough[: m.n_cells + m.exterior])
    if m.exterior:  # a cell that meets itself would surround others
        same = m.edge_cells[:, 0] == m.edge_cells[:, 1]
        sound &= ~jnp.any(same & m.alive_edges)
    return sound & ~has_new_overlaps(new, before)
