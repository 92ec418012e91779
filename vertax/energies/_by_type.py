"""Line tension by the types of the two cells of an edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from vertax._base.checks import as_real, check_shape, describe
from vertax._base.tracing import is_concrete
from vertax.energies._energy import AbstractLocalEnergy
from vertax.mesh import Tissue


class TypeTension(AbstractLocalEnergy):
    r"""$\sum_e \gamma_{st}\,\ell_e$ with the types $s$, $t$ of the two cells of each edge.

    Made by [`by_type`][vertax.energies.by_type]. A T1 transition changes the tension of the edge with its
    cells.
    """

    tension: Float[Array, " pairs"]
    r"""The upper triangle of the table, row by row: $\gamma_{00}, \gamma_{01}, \dots, \gamma_{11}, \dots$"""
    outline: Float[Array, "*types"] | None
    """Tension of edges on the outline: one, or one for the type of their cell; None without an outline."""
    types: Int[Array, " cells"]
    """Type of each cell."""

    @property
    def n_types(self) -> int:
        """Number of types."""
        return round((np.sqrt(8 * self.tension.size + 1) - 1) / 2)

    @property
    def table(self) -> Float[Array, "types types"]:
        """Tension by the types of both cells, a symmetric matrix."""
        types = jnp.arange(self.n_types)
        return self._between(types[:, None], types)

    def _between(self, one: Int[Array, "*n"], other: Int[Array, "*m"]) -> Float[Array, "..."]:
        """Tension between types, from their place in the upper triangle."""
        low, high = jnp.minimum(one, other), jnp.maximum(one, other)
        return self.tension[low * (2 * self.n_types - low - 1) // 2 + high]

    def edge_tensions(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Tension of each edge, energy per length; 0 for spare slots.

        **Raises:**

        - `ValueError` if the types are not those of the cells of the tissue, or if the tissue has an outline
            and the energy no tension for it.
        """
        n_cells = tissue.n_cells
        check_shape("types", self.types, (n_cells,), remedy="Give one for each cell.")
        if tissue.topology.exterior and self.outline is None:
            raise ValueError(
                "Parameter `outline` must be a tension for a tissue with an outline, but is None. Pass it to "
                "`by_type`, `outline=0.0` for none."
            )
        first, second = tissue.topology.edge_cells.T
        inside = (first < n_cells) & (second < n_cells)
        types = self.types.astype(jnp.int32)
        of_first, of_second = (jnp.take(types, c, mode="clip") for c in (first, second))
        tension = jnp.where(inside, self._between(of_first, of_second), 0)
        if self.outline is None:
            return tension
        outline = jnp.broadcast_to(self.outline, self.n_types)[of_first]  # the cell is the first
        return jnp.where(tissue.topology.on_outline, outline, tension)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return self.edge_tensions(tissue) * tissue.edge_lengths


def by_type(
    table: ArrayLike | Sequence[Any],
    types: ArrayLike | Sequence[Any],
    *,
    outline: ArrayLike | Sequence[Any] | None = None,
) -> TypeTension:
    r"""Line tension that depends on the types of the two cells of an edge: $\sum_e \gamma_{st}\,\ell_e$.

    ```python
    sorting = vx.energies.by_type([[0.14, 0.11], [0.11, 0.02]], types, outline=0.16)
    ```

    All entries are parameters, to which gradients flow: `tension`, the upper triangle of the table, and
    `outline`. With `types=jnp.arange(n_cells)` each pair of cells has its own tension, which it keeps
    when other cells change their neighbours. Differential adhesion after Nagai and Honda 2001,
    doi:10.1080/13642810108205772.

    **Arguments:**

    - `table`, shape `(types, types)`: $\gamma$ by the types of both cells, energy per length; symmetric.
    - `types`, shape `(cells,)`: the type of each cell, an integer from 0.
    - `outline`: tension of edges on the outline of a free tissue; a scalar or one for each type of the cell.

    **Returns:** a [`TypeTension`][vertax.energies.TypeTension].

    **Raises:**

    - `TypeError` unless the table and the outline hold real numbers.
    - `ValueError` for a table that is not square or not symmetric, types that are no integers or have no
        row in the table, or an outline of another shape.
    """
    table = as_real("table", table).astype(jnp.result_type(float))
    if table.ndim != 2 or table.shape[0] != table.shape[1] or not table.size:
        raise ValueError(
            f"Argument `table` must have shape (types, types), but has {table.shape}. Give a row and a "
            "column for each type."
        )
    if is_concrete(table) and not np.array_equal(table, table.T):
        raise ValueError(
            "Argument `table` must be symmetric, but is not: an edge has two sides. Give both entries of a "
            "pair the same value."
        )
    kinds = jnp.asarray(types)
    if kinds.ndim != 1 or not jnp.issubdtype(kinds.dtype, jnp.integer):
        raise ValueError(
            "Argument `types` must hold one integer for each cell, the row of its type in the table, but is "
            f"{describe(types)}."
        )
    outside = is_concrete(kinds) and (np.asarray(kinds) < 0) | (np.asarray(kinds) >= len(table))
    if np.any(outside):
        cell = int(np.flatnonzero(outside)[0])
        raise ValueError(
            f"Argument `types` must hold integers from 0 to {len(table) - 1}, rows of the table, but cell "
            f"{cell} has the type {int(kinds[cell])}."
        )
    if outline is not None:
        outline = as_real("outline", outline).astype(table.dtype)
        remedy = "Give one tension, or one for each type."
        check_shape("outline", outline, (), (len(table),), remedy=remedy)
    return TypeTension(table[jnp.triu_indices(len(table))], outline, kinds)
