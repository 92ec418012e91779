"""Forces on vertices."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Push(AbstractEnergy):
    r"""Constant forces on vertices, less the work that they do: $-\sum_v f_v \cdot x_v$.

    **Arguments:**

    - `force`: on each vertex, shape `(vertices, 2)`.
    """

    force: Float[Array, "vertices 2"]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Less the work of the forces."""
        return -jnp.sum(self.force * tissue.vertices)
