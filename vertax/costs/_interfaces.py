"""Length of interfaces between cells of the same type."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from vertax._base.checks import as_real, check_shape
from vertax._base.indexing import take
from vertax._base.tracing import is_concrete
from vertax.costs._cost import AbstractCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


def _as_types(value: ArrayLike | Sequence[int]) -> Int[Array, "..."]:
    """Convert whole numbers to an integer array."""
    types = as_real("cell_types", value)
    if is_concrete(types) and not bool(jnp.all(types == jnp.round(types))):
        raise ValueError(
            "Argument `cell_types` must hold whole numbers, but holds fractions. Convert other labels by "
            "numpy.unique(types, return_inverse=True)[1]."
        )
    return types.astype(int)


class HomotypicLength(AbstractCost):
    r"""Length of homotypic interfaces, between cells of the same type (paper, "Inverse patterning design").

    $$C = \sum_t \ell_{tt} \qquad\text{or}\qquad C = \sum_t \ell_{tt} \, / \, \ell_\mathrm{tot}$$

    over all types $t$, where $\ell_\mathrm{tot}$ is the length of all interfaces between two cells. Edges on
    the outline of a free tissue are not interfaces. With two types, one minus the relative cost is the
    paper's heterotypic fraction $\ell_{12} / \ell_\mathrm{tot}$.

    With two types every vertex has a homotypic interface, because two of the three cells at a vertex have
    the same type. The cost can still vanish: homotypic interfaces can shrink to length 0, to fourfold
    vertices as in a checkerboard.

    **Arguments:**

    - `cell_types`: the type of each cell, a whole number.
    - `relative`: divide by the length of all interfaces.

    **Raises:**

    - `ValueError` for fractions, and for a number of types other than the number of cells.
    - `TypeError` for types that are not numbers.
    """

    cell_types: Int[Array, " cells"] = eqx.field(converter=_as_types)
    relative: bool = eqx.field(static=True, default=False)

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Length of homotypic interfaces, or its fraction."""
        remedy = "Give one type for each cell."
        check_shape("cell_types", self.cell_types, (tissue.n_cells,), remedy=remedy)
        cells = tissue.topology.edge_cells
        inner = ~tissue.topology.on_outline
        types = take(self.cell_types, jnp.minimum(cells, tissue.n_cells - 1))
        homotypic = inner & (types[:, 0] == types[:, 1])
        lengths = tissue.edge_lengths
        homotypic_length = jnp.sum(jnp.where(homotypic, lengths, 0))
        return (
            homotypic_length / jnp.sum(jnp.where(inner, lengths, 0))
            if self.relative
            else homotypic_length
        )
