"""Which kinds of cells touch."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from vertax._base.checks import as_real
from vertax._base.modules import is_concrete
from vertax.costs._cost import AbstractCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._topology import take


def _as_types(value: ArrayLike | Sequence[int]) -> Int[Array, "..."]:
    """Whole numbers as integers."""
    types = as_real("cell_types", value)
    if is_concrete(types) and not bool(jnp.all(types == jnp.round(types))):
        raise ValueError(
            "Argument `cell_types` must hold whole numbers, one for each type, but holds fractions. "
            "numpy.unique(types, return_inverse=True)[1] numbers what is anything else."
        )
    return types.astype(int)


class HomotypicLength(AbstractCost):
    r"""Length of the interfaces between cells of one type (paper, "Inverse patterning design").

    $$C = \sum_t \ell_{tt} \qquad\text{or}\qquad C = \sum_t \ell_{tt} \, / \, \ell_\mathrm{tot}$$

    over the types $t$, of which there may be any number; $\ell_\mathrm{tot}$ is the length of all
    interfaces between two cells. Edges on the outline of a free tissue are no interfaces. One minus the
    relative cost is the heterotypic share, the paper's $\ell_{12} / \ell_\mathrm{tot}$.

    At a vertex three cells meet, and of three cells at least two are of one type if there are only two
    types: no junction of three is without a homotypic interface. The cost can vanish all the same,
    where these interfaces shrink to points, at which four cells meet as in a checkerboard.

    **Arguments:**

    - `cell_types`: a whole number for each cell.
    - `relative`: divide by the length of all interfaces.

    **Raises:**

    - `ValueError` if the number of types is not that of the cells, or for types that are no whole numbers.
    - `TypeError` for types that are no numbers.
    """

    cell_types: Int[Array, " cells"] = eqx.field(converter=_as_types)
    relative: bool = eqx.field(static=True, default=False)

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Length of the interfaces within types, or its share."""
        if self.cell_types.shape != (tissue.n_cells,):
            raise ValueError(
                f"The types of HomotypicLength must have one entry per cell, shape ({tissue.n_cells},), "
                f"but their shape is {self.cell_types.shape}."
            )
        cells = tissue.topology.edge_cells
        inner = ~tissue.topology.on_outline
        types = take(self.cell_types, jnp.minimum(cells, tissue.n_cells - 1))
        homotypic = inner & (types[:, 0] == types[:, 1])
        lengths = tissue.edge_lengths
        within = jnp.sum(jnp.where(homotypic, lengths, 0))
        return within / jnp.sum(jnp.where(inner, lengths, 0)) if self.relative else within
