"""Pressures of cells and tensions of edges, of any energy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.announce import announced_jit
from vertax._base.model_checks import real_scalar
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import check_system
from vertax.mesh import Tissue
from vertax.mesh._tissue import Measurements


class _OffsetTissue(Tissue):
    """A tissue with offsets added to its areas and edge lengths."""

    area_offset: Float[Array, " cells"]
    length_offset: Float[Array, " edges"]

    def __init__(
        self, tissue: Tissue, area: Float[Array, " cells"], length: Float[Array, " edges"]
    ):
        for name in Tissue.__dataclass_fields__:
            setattr(self, name, getattr(tissue, name))
        self.area_offset, self.length_offset = area, length

    def measured(self) -> Measurements:
        """Areas and edge lengths with their offsets, and the perimeters that follow."""
        measures = super().measured()
        perimeter_offset = self.cell_sums((self.length_offset, self.length_offset))
        return Measurements(
            measures.lengths + self.length_offset,
            measures.areas + self.area_offset,
            measures.perimeters + perimeter_offset,
        )


def pressures(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " cells"]:
    r"""Pressure in each cell, $p_c = -\partial E / \partial A_c$ at given edge lengths, energy per area.

    **Arguments:**

    - `tissue`: the tissue, relaxed or not.
    - `energy`: any energy that takes areas from `tissue.areas` or `tissue.shape_factors`. Areas that it
        computes from vertices do not contribute.

    **Returns:** one pressure per cell, positive in a cell that would expand.

    **Raises:** as [`stress`][vertax.mechanics.stress].
    """
    return pressures_and_tensions(tissue, energy)[0]


def tensions(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " edges"]:
    r"""Tension of each edge, $T_e = \partial E / \partial \ell_e$ at given areas, energy per length.

    The tension of an edge between two cells is the sum of its line tension and of the perimeter tensions of
    both cells.

    **Arguments:**

    - `tissue`: the tissue, relaxed or not.
    - `energy`: any energy that takes lengths from `tissue.edge_lengths`, `tissue.perimeters` or
        `tissue.shape_factors`. Lengths that it computes from vertices do not contribute.

    **Returns:** one tension per edge, positive in an edge that would contract.

    **Raises:** as [`stress`][vertax.mechanics.stress].
    """
    return pressures_and_tensions(tissue, energy)[1]


def pressures_and_tensions(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, " cells"], Float[Array, " edges"]]:
    """Pressures of cells and tensions of edges, from one gradient."""
    check_system(tissue, energy)
    return _pressures_and_tensions(*traced((tissue, energy), tissue.vertices.dtype))


@announced_jit
def _pressures_and_tensions(
    tissue: Tissue, energy: AbstractEnergy
) -> tuple[Float[Array, " cells"], Float[Array, " edges"]]:
    dtype = tissue.vertices.dtype
    zeros = (jnp.zeros(tissue.n_cells, dtype), jnp.zeros(tissue.n_edges, dtype))
    at = lambda offsets: real_scalar(energy(_OffsetTissue(tissue, *offsets)))
    by_area, by_length = jax.grad(at)(zeros)
    return -by_area, by_length
