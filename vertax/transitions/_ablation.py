"""Ablation: a laser cuts edges and kills cells."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from vertax._base.checks import named
from vertax.energies import Ablated, AbstractEnergy, AbstractLocalEnergy
from vertax.mesh import Tissue
from vertax.mesh._surgery import merge_cells
from vertax.mesh._topology import take


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
    """
    if not isinstance(energy, AbstractLocalEnergy):
        raise TypeError(
            "Argument `energy` must be a sum over cells and edges, an AbstractLocalEnergy, but is "
            f"{named(energy)}."
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
    return _merged(tissue, left.cells), left


@eqx.filter_jit
def _merged(tissue: Tissue, holes: Bool[Array, " cells"]) -> Tissue:
    """The tissue with neighbouring holes made one."""
    hole = jnp.append(holes, jnp.zeros(2, bool))  # neither the exterior nor what is nowhere

    def between(tissue: Tissue) -> Array:
        cells = tissue.topology.edge_cells
        return jnp.all(take(hole, cells), axis=-1) & (cells[:, 0] != cells[:, 1])

    def one(tissue: Tissue) -> Tissue:
        m = tissue.topology
        h = take(m.half_edge, jnp.argmax(between(tissue)))
        return tissue.with_topology(merge_cells(m, h, jnp.array(True)))

    return jax.lax.while_loop(lambda t: jnp.any(between(t)), one, tissue)
