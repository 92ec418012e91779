"""The space a tissue lives in."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from vertax._misc import is_concrete


class AbstractBoundary(eqx.Module):
    """The space a tissue lives in: how lattice images are placed and which motions cost nothing."""

    @abc.abstractmethod
    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        """Displacement of an integer lattice image from the home box."""

    @abc.abstractmethod
    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        """The shortest of all displacements that lead to an image of the same point."""

    @abc.abstractmethod
    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        """How far a configuration moved along the motions that change no shape.

        One number for each zero mode, in units of length times the square root of the number of
        vertices: the norm of the part of the displacement that lies along that mode. Motions that
        `pinned` vertices rule out are no zero modes, and count as 0.
        """


class Periodic(AbstractBoundary):
    """A periodic box spanned by two lattice vectors; differentiable, sheared boxes included.

    Its two zero modes are the translations.

    **Arguments:**

    - `lattice`, shape `(2, 2)`: the two lattice vectors as rows, in units of length; right-handed.

    **Raises:**

    - `ValueError` if the lattice is not finite, or not right-handed with a positive area.
    """

    lattice: Float[Array, "2 2"]

    def __init__(self, lattice: ArrayLike):
        lattice = jnp.asarray(lattice)
        if lattice.shape != (2, 2):
            raise ValueError(
                "Argument `lattice` must hold two lattice vectors as rows, shape (2, 2), but its shape "
                f"is {lattice.shape}. For a rectangle pass jnp.diag(jnp.array([width, height]))."
            )
        if is_concrete(lattice):
            rows = np.asarray(lattice, float)
            if not np.isfinite(rows).all() or np.linalg.det(rows) <= 0:
                raise ValueError(
                    "Argument `lattice` must be finite and right-handed (positive determinant), but is "
                    f"{rows.tolist()}."
                )
        self.lattice = lattice

    @property
    def area(self) -> Float[Array, ""]:
        """Area of the box."""
        return jnp.linalg.det(self.lattice)

    def translation(self, image: Num[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        # Written out: a matrix product would run in reduced precision on some accelerators.
        image = jnp.asarray(image, self.lattice.dtype)
        return image[..., :1] * self.lattice[0] + image[..., 1:] * self.lattice[1]

    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        """The shortest of all displacements that lead to an image of the same point.

        Exact for boxes that lean by at most half their width (for others as long as the shortest
        displacement is shorter than half the distance between opposite sides).
        """
        # Rounding the fractions finds the image within the parallelogram around 0; in a leaning box one
        # of its neighbours may still be closer.
        inverse = jnp.linalg.inv(self.lattice)
        nearest = jax.lax.stop_gradient(jnp.round(displacement @ inverse))
        steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        images = nearest[..., None, :] + jnp.asarray(steps, nearest.dtype)
        choices = displacement[..., None, :] - self.translation(images)
        best = jnp.argmin(jnp.sum(choices**2, axis=-1), axis=-1)
        return jnp.take_along_axis(choices, best[..., None, None], axis=-2)[..., 0, :]

    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        return _translation_drift(vertices - reference, pinned)


class Free(AbstractBoundary):
    """The plane: a cluster of cells with an exterior around it.

    Its three zero modes are the translations and the rotation. Give the tissue `angles`, and edges with
    the exterior on one side are circular arcs.
    """

    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        return jnp.zeros_like(image)

    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        return displacement

    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        displacement = vertices - reference
        # The rotation is about the centroid, or about the one vertex that is pinned.
        if pinned is None:
            centre, rotates = jnp.mean(reference, axis=0), True
        else:
            n_pinned = jnp.sum(pinned)
            weight = jnp.where(n_pinned > 0, pinned, True)[:, None]
            centre = jnp.sum(jnp.where(weight, reference, 0), axis=0) / jnp.sum(weight)
            rotates = n_pinned <= 1
        arm = reference - centre
        size = jnp.sqrt(jnp.sum(arm**2))
        turn = jnp.sum(arm[:, 0] * displacement[:, 1] - arm[:, 1] * displacement[:, 0])
        turn = jnp.where(rotates, turn / size, 0)
        return jnp.append(_translation_drift(displacement, pinned), turn)


def _translation_drift(
    displacement: Float[Array, "vertices 2"], pinned: Bool[Array, " vertices"] | None
) -> Float[Array, "2"]:
    drift = jnp.mean(displacement, axis=0) * jnp.sqrt(1.0 * displacement.shape[0])
    return drift if pinned is None else jnp.where(jnp.any(pinned), 0, drift)
