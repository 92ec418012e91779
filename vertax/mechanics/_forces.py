"""Pressures of cells and tensions of edges, of any energy."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_system
from vertax.mesh import Tissue
from vertax.mesh._tissue import Measurements


class _Slackened(Tissue):
    """A tissue whose areas and edge lengths are what its vertices say, and something more."""

    more_area: Float[Array, " cells"]
    more_length: Float[Array, " edges"]

    def __init__(
        self, tissue: Tissue, area: Float[Array, " cells"], length: Float[Array, " edges"]
    ):
        for name in Tissue.__dataclass_fields__:
            setattr(self, name, getattr(tissue, name))
        self.more_area, self.more_length = area, length

    def measured(self) -> Measurements:
        """Areas and edge lengths, and more; perimeters follow."""
        known = super().measured()
        around = self.cell_sums((self.more_length, self.more_length))
        return Measurements(
            known.lengths + self.more_length,
            known.areas + self.more_area,
            known.perimeters + around,
        )


def pressures(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " cells"]:
    r"""Pressure in each cell, $p_c = -\partial E / \partial A_c$ at given edge lengths, energy per area.

    **Arguments:**

    - `tissue`: the tissue, relaxed or not.
    - `energy`: any energy. What it knows of areas it must have from `tissue.areas` or
        `tissue.shape_factors`; what it has from vertices is not seen.

    **Returns:** one pressure a cell, positive in a cell that would expand.

    **Raises:** as [`stress`][vertax.mechanics.stress].
    """
    return pressures_and_tensions(tissue, energy)[0]


def tensions(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " edges"]:
    r"""Tension of each edge, $T_e = \partial E / \partial \ell_e$ at given areas, energy per length.

    An edge between two cells has the tensions of both their perimeters, and its own.

    **Arguments:**

    - `tissue`: the tissue, relaxed or not.
    - `energy`: any energy. What it knows of lengths it must have from `tissue.edge_lengths`,
        `tissue.perimeters` or `tissue.shape_factors`; what it has from vertices is not seen.

    **Returns:** one tension an edge, positive in an edge that would contract.

    **Raises:** as [`stress`][vertax.mechanics.stress].
    """
    return pressures_and_tensions(tissue, energy)[1]


def pressures_and_tensions(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, " cells"], Float[Array, " edges"]]:
    """Both at once."""
    check_system(tissue, energy)
    return _pressures_and_tensions(*traced((tissue, energy), tissue.vertices.dtype))


@eqx.filter_jit
def _pressures_and_tensions(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, " cells"], Float[Array, " edges"]]:
    dtype = tissue.vertices.dtype
    none = (jnp.zeros(tissue.n_cells, dtype), jnp.zeros(tissue.n_edges, dtype))
    by_area, by_length = jax.grad(lambda more: energy(_Slackened(tissue, *more)))(none)
    return -by_area, by_length
