"""Tension along edges."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._tissue import Tissue
from vertax.energies._energy import AbstractLocalEnergy, per_edge


class LineTension(AbstractLocalEnergy):
    r"""$\sum_e \gamma_e\,\ell_e$, each edge counted once (Farhadifar et al. 2007).

    With [`AreaElasticity`][vertax.energies.AreaElasticity] the paper's second energy,
    $E_2 = \tfrac12 K \sum_c (A_c - A^0_c)^2 + \sum_e \gamma_e \ell_e$.

    **Arguments:**

    - `tension`: line tension $\gamma$, energy per length; scalar or one an edge.
    """

    tension: Float[Array, "*edges"] = eqx.field(converter=jnp.asarray)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return per_edge(self.tension, tissue, "tension") * tissue.edge_lengths
