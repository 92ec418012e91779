"""What a step in time minimises."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Incremental(AbstractEnergy):
    """The energy at the end of a step, and what the step dissipates.

    **Arguments:**

    - `energy`: that of the tissue, less the work of what drives it.
    - `dissipation`: what resists.
    - `before`: where the step begins.
    - `dt`: its length.
    - `strained`: strains that an earlier stage of the step is to be extrapolated by, for second order.
    """

    energy: AbstractEnergy
    dissipation: AbstractDissipation
    before: Tissue
    dt: Float[Array, ""]
    strained: Float[Array, " strains"] | None = None

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The incremental potential."""
        if self.strained is None or not isinstance(self.dissipation, AbstractViscosity):
            return self.energy(tissue) + self.dissipation(tissue, self.before, self.dt)
        strains = self.dissipation.strains(tissue, self.before) - self.strained
        return self.energy(tissue) + 0.5 * jnp.sum(strains**2) / self.dt
