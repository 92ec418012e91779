"""Laser ablation: an energy without the terms of some cells and edges."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from vertax._base.checks import check_shape, describe
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
    r"""An energy without the terms of ablated cells and edges.

    A cut edge has no tension. An ablated cell is a hole: it has no area elasticity and no perimeter
    elasticity. The terms of all other cells and edges are unchanged.

    ```python
    cut = vx.energies.Ablated(energy, edges=jnp.arange(tissue.n_edges) == 7)
    recoil = vx.evolve(tissue, cut, friction, times)
    ```

    **Arguments:**

    - `energy`: the energy before ablation, a sum over cells and edges.
    - `cells`, shape `(cells,)`: True for ablated cells; by default none.
    - `edges`, shape `(edges,)`: True for cut edges; by default none.

    **Raises:**

    - `ValueError` when the energy is evaluated, for a mask of the wrong length.
    """

    energy: AbstractLocalEnergy
    cells: Bool[Array, "*cells"] | None = eqx.field(
        default=None, converter=partial(_as_mask, "cells")
    )
    edges: Bool[Array, "*edges"] | None = eqx.field(
        default=None, converter=partial(_as_mask, "edges")
    )

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell; 0 for ablated cells."""
        terms = self.energy.cell_terms(tissue)
        return _masked(terms, self.cells, "cells", tissue.n_cells)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge; 0 for cut edges."""
        terms = self.energy.edge_terms(tissue)
        return _masked(terms, self.edges, "edges", tissue.n_edges)


def _masked(
    terms: Float[Array, "*n"], mask: Bool[Array, "..."] | None, name: str, size: int
) -> Float[Array, "*n"]:
    """The terms, with 0 where the mask is True."""
    if mask is None:
        return terms
    check_shape(name, mask, (size,))
    return jnp.where(mask, 0, terms)
