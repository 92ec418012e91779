"""Viscosity of edges, perimeters and areas."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.dissipations._dissipation import AbstractViscosity
from vertax.dissipations._friction import as_coefficient, broadcast_coefficient
from vertax.mesh import Tissue


class EdgeViscosity(AbstractViscosity):
    r"""Viscosity of edges, $R = \tfrac12 \sum_e \eta_e\,\dot\ell_e^2 / \ell_e$: a dashpot along each edge.

    **Arguments:**

    - `viscosity`: $\eta$, force times time over relative elongation; a scalar or one per edge.

    **Raises:**

    - `ValueError` for a negative viscosity or a wrong shape.
    """

    viscosity: Float[Array, "*edges"] = eqx.field(converter=partial(as_coefficient, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        r"""$\sqrt{\eta_e / \ell_e}\,\Delta\ell_e$."""
        viscosity = broadcast_coefficient(self.viscosity, tissue.n_edges, "viscosity", "edge")
        length = before.edge_lengths
        return jnp.sqrt(viscosity / jnp.where(length > 0, length, 1)) * (
            tissue.edge_lengths - length
        )


class PerimeterViscosity(AbstractViscosity):
    r"""Viscosity of cell perimeters (cortices), $R = \tfrac12 \sum_c \eta_c \dot P_c^2$.

    **Arguments:**

    - `viscosity`: $\eta$, force times time over length; a scalar or one per cell.

    **Raises:**

    - `ValueError` for a negative viscosity or a wrong shape.
    """

    viscosity: Float[Array, "*cells"] = eqx.field(converter=partial(as_coefficient, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        r"""$\sqrt{\eta_c}\,\Delta P_c$."""
        viscosity = broadcast_coefficient(self.viscosity, tissue.n_cells, "viscosity", "cell")
        return jnp.sqrt(viscosity) * (tissue.perimeters - before.perimeters)


class AreaViscosity(AbstractViscosity):
    r"""Viscosity of cell areas, $R = \tfrac12 \sum_c \mu_c \dot A_c^2$.

    **Arguments:**

    - `viscosity`: $\mu$, pressure times time over area; a scalar or one per cell.

    **Raises:**

    - `ValueError` for a negative viscosity or a wrong shape.
    """

    viscosity: Float[Array, "*cells"] = eqx.field(converter=partial(as_coefficient, "viscosity"))

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        r"""$\sqrt{\mu_c}\,\Delta A_c$."""
        viscosity = broadcast_coefficient(self.viscosity, tissue.n_cells, "viscosity", "cell")
        return jnp.sqrt(viscosity) * (tissue.areas - before.areas)
