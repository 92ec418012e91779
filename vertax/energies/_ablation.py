"""Ablation: what a laser takes away of an energy."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from vertax._base.checks import describe
from vertax.energies._energy import AbstractLocalEnergy
from vertax.mesh import Tissue


def _as_mask(name: str, value: ArrayLike | None) -> Bool[Array, "..."] | None:
    if value is None:
        return None
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"Argument `{name}` must be a mask of booleans, but is {describe(value)}.")
    return jnp.asarray(array) != 0


class Ablated(AbstractLocalEnergy):
    r"""An energy of which some cells and edges have lost their part, as after a cut by a laser.

    A cut edge has no tension any more; a cell that is gone is a hole, which neither resists a change of its
    area nor has a perimeter. Their neighbours are as they were.

    ```python
    cut = vx.energies.Ablated(energy, edges=jnp.arange(tissue.n_edges) == 7)
    recoil = vx.evolve(tissue, cut, friction, times)
    ```

    **Arguments:**

    - `energy`: the energy before, a sum over cells and edges.
    - `cells`, shape `(cells,)`: which cells are holes; by default none.
    - `edges`, shape `(edges,)`: which edges are cut; by default none.

    **Raises:**

    - `ValueError` in an energy for masks of the wrong length.
    """

    energy: AbstractLocalEnergy
    cells: Bool[Array, "*cells"] | None = eqx.field(
        default=None, converter=partial(_as_mask, "cells")
    )
    edges: Bool[Array, "*edges"] | None = eqx.field(
        default=None, converter=partial(_as_mask, "edges")
    )

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell that is no hole."""
        terms = self.energy.cell_terms(tissue)
        return _without(terms, self.cells, "cells", tissue.n_cells)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge that is not cut."""
        terms = self.energy.edge_terms(tissue)
        return _without(terms, self.edges, "edges", tissue.n_edges)


def _without(
    terms: Float[Array, "*n"], mask: Bool[Array, "..."] | None, name: str, size: int
) -> Float[Array, "*n"]:
    if mask is None:
        return terms
    if mask.shape != (size,):
        raise ValueError(f"Argument `{name}` must have shape ({size},), but has {mask.shape}.")
    return jnp.where(mask, 0, terms)
