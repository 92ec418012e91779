"""Constant forces on vertices."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Push(AbstractEnergy):
    r"""Potential of constant forces on vertices, $-\sum_v f_v \cdot x_v$.

    On a surface $f_v$ is the force along the coordinates of the chart, $J^T F$ for a force $F$ in space.

    **Arguments:**

    - `force`, shape `(vertices, 2)`: $f_v$, the force on each vertex.
    """

    force: Float[Array, "vertices 2"]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """Potential energy of the forces."""
        return -jnp.sum(self.force * tissue.vertices)
