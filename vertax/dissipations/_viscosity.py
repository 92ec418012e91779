"""Viscosity of what a tissue consists of."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.dissipations._dissipation import AbstractViscosity
from vertax.dissipations._friction import coefficient_of, entries
from vertax.mesh import Tissue


class EdgeViscosity(AbstractViscosity):
    r"""Viscosity of edges, $R = \tfrac12 \sum_e \eta_e\,\dot\ell_e^2 / \ell_e$, a dashpot along each.

    **Arguments:**

    - `viscosity`: $\eta$, force times time over relative elongation; a scalar or one an edge.

    **Raises:**

    - `ValueError` for a negative viscosity or one of another shape.
    """

    viscosity: Float[Array, "*edges"] = eqx.field(converter=partial(coefficient_of, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Elongations, weighted."""
        viscosity = entries(self.viscosity, tissue.n_edges, "viscosity", "edge")
        length = before.edge_lengths
        return jnp.sqrt(viscosity / jnp.where(length > 0, length, 1)) * (
            tissue.edge_lengths - length
        )


class PerimeterViscosity(AbstractViscosity):
    r"""Viscosity of cortices, $R = \tfrac12 \sum_c \eta_c \dot P_c^2$.

    **Arguments:**

    - `viscosity`: $\eta$, force times time over length; a scalar or one a cell.

    **Raises:**

    - `ValueError` for a negative viscosity or one of another shape.
    """

    viscosity: Float[Array, "*cells"] = eqx.field(converter=partial(coefficient_of, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Changes of perimeters, weighted."""
        viscosity = entries(self.viscosity, tissue.n_cells, "viscosity", "cell")
        return jnp.sqrt(viscosity) * (tissue.perimeters - before.perimeters)


class AreaViscosity(AbstractViscosity):
    r"""Viscosity of cells against a change of area, $R = \tfrac12 \sum_c \mu_c \dot A_c^2$.

    **Arguments:**

    - `viscosity`: $\mu$, pressure times time over area; a scalar or one a cell.

    **Raises:**

    - `ValueError` for a negative viscosity or one of another shape.
    """

    viscosity: Float[Array, "*cells"] = eqx.field(converter=partial(coefficient_of, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Changes of areas, weighted."""
        viscosity = entries(self.viscosity, tissue.n_cells, "viscosity", "cell")
        return jnp.sqrt(viscosity) * (tissue.areas - before.areas)
