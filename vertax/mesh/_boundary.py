"""The space a tissue lives in."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from vertax._base.checks import describe
from vertax._base.tracing import is_concrete


class AbstractBoundary(eqx.Module):
    """The space a tissue lives in: how lattice images are placed and which motions cost nothing."""

    @abc.abstractmethod
    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        """Displacement of an integer lattice image from the home box."""

    @abc.abstractmethod
    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        """The shortest of all displacements that lead to an image of the same point."""

    @abc.abstractmethod
    def carry(
        self, vertices: Float[Array, "vertices 2"], other: AbstractBoundary
    ) -> Float[Array, "vertices 2"]:
        """Where vertices go when this space is deformed uniformly into another one of its kind.

        **Raises:**

        - `TypeError` if the other one is of another kind.
        """

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

    @abc.abstractmethod
    def settle(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, "vertices 2"]:
        """The vertices, moved as a whole such that nothing is left of their drift."""

    @abc.abstractmethod
    def motions(
        self, vertices: Float[Array, "vertices 2"], distance: Float[Array, ""]
    ) -> Float[Array, "modes vertices 2"]:
        """The vertices, moved as a whole by about a distance, for each of the modes of `drift`."""


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
        inverse = inverse_of(self.lattice)
        nearest = jax.lax.stop_gradient(jnp.round(displacement @ inverse))
        steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        images = nearest[..., None, :] + jnp.asarray(steps, nearest.dtype)
        choices = displacement[..., None, :] - self.translation(images)
        best = jnp.argmin(jnp.sum(choices**2, axis=-1), axis=-1)
        return jnp.take_along_axis(choices, best[..., None, None], axis=-2)[..., 0, :]

    def carry(
        self, vertices: Float[Array, "vertices 2"], other: AbstractBoundary
    ) -> Float[Array, "vertices 2"]:
        if not isinstance(other, Periodic):
            raise _of_another_kind(self, other)
        # As a displacement, so that a box that stays as it is leaves the vertices alone to the last bit.
        (p, q), (r, s) = inverse_of(self.lattice)
        x, y = vertices[:, :1], vertices[:, 1:]
        first, second = p * x + r * y, q * x + s * y
        deformation = other.lattice - self.lattice
        return vertices + first * deformation[0] + second * deformation[1]

    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        return _translation_drift(vertices - reference, pinned)

    def settle(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, "vertices 2"]:
        back = jnp.mean(reference - vertices, axis=0)
        return vertices + (back if pinned is None else jnp.where(jnp.any(pinned), 0, back))

    def motions(
        self, vertices: Float[Array, "vertices 2"], distance: Float[Array, ""]
    ) -> Float[Array, "modes vertices 2"]:
        return vertices + distance * jnp.eye(2, dtype=vertices.dtype)[:, None]


class Free(AbstractBoundary):
    """The plane: a cluster of cells with an exterior around it.

    Its three zero modes are the translations and the rotation. Give the tissue `angles`, and edges with
    the exterior on one side are circular arcs.
    """

    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        return jnp.zeros_like(image)

    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        return displacement

    def carry(
        self, vertices: Float[Array, "vertices 2"], other: AbstractBoundary
    ) -> Float[Array, "vertices 2"]:
        if not isinstance(other, Free):
            raise _of_another_kind(self, other)
        return vertices

    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        displacement = vertices - reference
        centre, rotates = _pivot(reference, pinned)
        arm = reference - centre
        turn = jnp.sum(_cross(arm, displacement)) / jnp.sqrt(jnp.sum(arm**2))
        turn = jnp.where(rotates, turn, 0)
        return jnp.append(_translation_drift(displacement, pinned), turn)

    def settle(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, "vertices 2"]:
        (centre, rotates), (pivot, _) = _pivot(reference, pinned), _pivot(vertices, pinned)
        arm, moved = reference - centre, vertices - pivot
        turn = jnp.arctan2(jnp.sum(_cross(moved, arm)), jnp.sum(moved * arm))
        return jnp.where(rotates, centre + _turned(moved, turn), vertices)

    def motions(
        self, vertices: Float[Array, "vertices 2"], distance: Float[Array, ""]
    ) -> Float[Array, "modes vertices 2"]:
        shifted = vertices + distance * jnp.eye(2, dtype=vertices.dtype)[:, None]
        centre = jnp.mean(vertices, axis=0)
        arm = vertices - centre
        turn = distance / jnp.sqrt(jnp.mean(jnp.sum(arm**2, axis=-1)))
        return jnp.concatenate([shifted, (centre + _turned(arm, turn))[None]])


def _of_another_kind(one: AbstractBoundary, other: AbstractBoundary) -> TypeError:
    return TypeError(
        f"A tissue in a {type(one).__name__} boundary needs another such boundary to go to, not "
        f"{describe(other) if not isinstance(other, AbstractBoundary) else type(other).__name__}."
    )


def _pivot(
    vertices: Float[Array, "vertices 2"], pinned: Bool[Array, " vertices"] | None
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """What a free tissue can turn about, if it can: its centroid, or the one vertex that is pinned."""
    if pinned is None:
        return jnp.mean(vertices, axis=0), jnp.array(True)
    n_pinned = jnp.sum(pinned)
    counts = jnp.where(n_pinned > 0, pinned, True)[:, None]
    centre = jnp.sum(jnp.where(counts, vertices, 0), axis=0) / jnp.sum(counts)
    return centre, n_pinned <= 1


def _turned(p: Float[Array, "n 2"], angle: Float[Array, ""]) -> Float[Array, "n 2"]:
    """Vectors turned counter-clockwise."""
    aside = jnp.stack([-p[:, 1], p[:, 0]], axis=-1)
    return jnp.cos(angle) * p + jnp.sin(angle) * aside


def _cross(p: Float[Array, "n 2"], q: Float[Array, "n 2"]) -> Float[Array, " n"]:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]


def _translation_drift(
    displacement: Float[Array, "vertices 2"], pinned: Bool[Array, " vertices"] | None
) -> Float[Array, "2"]:
    drift = jnp.mean(displacement, axis=0) * jnp.sqrt(1.0 * displacement.shape[0])
    return drift if pinned is None else jnp.where(jnp.any(pinned), 0, drift)


def inverse_of(lattice: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """The inverse of two lattice vectors, written out: that of larger matrices takes long to compile."""
    (a, b), (c, d) = lattice
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / (a * d - b * c)
