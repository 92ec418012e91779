"""Distance between the vertices of two tissues."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._tissue import Tissue
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy


class VertexDistance(AbstractLeastSquaresCost):
    r"""Mean squared distance of vertices to those of a target tissue (paper, "v2v" cost).

    $$C = \frac{1}{2N}\sum_{i=1}^{N} \|x_i - x_{\mathrm{target},i}\|^2$$

    over the $N$ vertices, in units of length squared; across a periodic boundary the shorter way
    counts. Vertices are compared by number, so tissue and target should have one topology: after a T1
    between them, numbers stand for different places.

    **Arguments:**

    - `target`: the target tissue, with as many vertices.

    **Raises:**

    - `ValueError` if the numbers of vertices differ.
    """

    target: Tissue

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Displacements from the target over the root of the number of vertices."""
        if tissue.n_vertices != self.target.n_vertices:
            raise ValueError(
                f"The target of VertexDistance must have {tissue.n_vertices} vertices, as the tissue "
                f"has, but has {self.target.n_vertices}."
            )
        displacement = tissue.boundary.shortest(tissue.vertices - self.target.vertices)
        return displacement.ravel() / jnp.sqrt(1.0 * tissue.n_vertices)
