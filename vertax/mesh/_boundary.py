"""The boundary of a tissue: a periodic box or the plane."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from vertax._base.checks import check_shape, describe
from vertax._base.plane import cross, inverse_of
from vertax._base.tracing import is_concrete


class AbstractBoundary(eqx.Module):
    """The boundary of a tissue: translations of lattice images, and zero modes."""

    @abc.abstractmethod
    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        """Displacement of a lattice image (two integers) from the home box."""

    @abc.abstractmethod
    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        """The minimum-image displacement: the shortest one to any image of the same point."""

    @abc.abstractmethod
    def carry(
        self, vertices: Float[Array, "vertices 2"], other: AbstractBoundary
    ) -> Float[Array, "vertices 2"]:
        """The vertices after a uniform deformation of this boundary into `other`.

        **Raises:**

        - `TypeError` if `other` is of another class.
        """

    @abc.abstractmethod
    def drift(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, " modes"]:
        """Components of the displacement from `reference` along the zero modes.

        One number for each zero mode, in units of length times the square root of the number of
        vertices: the norm of the projection of the displacement on that mode. It is 0 for motions that
        `pinned` vertices prevent.
        """

    @abc.abstractmethod
    def settle(
        self,
        vertices: Float[Array, "vertices 2"],
        reference: Float[Array, "vertices 2"],
        pinned: Bool[Array, " vertices"] | None = None,
    ) -> Float[Array, "vertices 2"]:
        """The vertices after the rigid motion that makes their drift 0."""

    @abc.abstractmethod
    def motions(
        self, vertices: Float[Array, "vertices 2"], distance: Float[Array, ""]
    ) -> Float[Array, "modes vertices 2"]:
        """The vertices after a rigid motion of about `distance` along each zero mode."""


class Periodic(AbstractBoundary):
    """A periodic box with two lattice vectors, also sheared; differentiable in the lattice.

    There are two zero modes, the translations.

    **Arguments:**

    - `lattice`, shape `(2, 2)`: the two lattice vectors as rows, in units of length; right-handed.

    **Raises:**

    - `ValueError` if the lattice is not finite, or not right-handed with a positive area.
    """

    lattice: Float[Array, "2 2"]

    def __init__(self, lattice: ArrayLike):
        lattice = jnp.asarray(lattice)
        remedy = "For a rectangle pass jnp.diag(jnp.array([width, height]))."
        check_shape("lattice", lattice, (2, 2), remedy=remedy)
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
        """The minimum-image displacement: the shortest one to any image of the same point.

        Exact if the second lattice vector leans by at most half the width of the box; otherwise exact for
        displacements shorter than half the distance between opposite sides of the box.
        """
        # Rounding the fractional coordinates gives the image in the parallelogram around 0; in a sheared box
        # one of the eight images next to it may be closer.
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
            raise _boundary_type_error(self, other)
        # As a displacement, so that the vertices are unchanged to the last bit if the box is.
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
    """The plane: a cluster of cells surrounded by an exterior.

    There are three zero modes: two translations and the rotation. If the tissue has `angles`, edges on the
    outline are circular arcs.
    """

    def translation(self, image: Num[Array, "*shape 2"]) -> Num[Array, "*shape 2"]:
        return jnp.zeros_like(image)

    def shortest(self, displacement: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
        return displacement

    def carry(
        self, vertices: Float[Array, "vertices 2"], other: AbstractBoundary
    ) -> Float[Array, "vertices 2"]:
        if not isinstance(other, Free):
            raise _boundary_type_error(self, other)
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
        turn = jnp.sum(cross(arm, displacement)) / jnp.sqrt(jnp.sum(arm**2))
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
        turn = jnp.arctan2(jnp.sum(cross(moved, arm)), jnp.sum(moved * arm))
        return jnp.where(rotates, centre + _rotated(moved, turn), vertices)

    def motions(
        self, vertices: Float[Array, "vertices 2"], distance: Float[Array, ""]
    ) -> Float[Array, "modes vertices 2"]:
        shifted = vertices + distance * jnp.eye(2, dtype=vertices.dtype)[:, None]
        centre = jnp.mean(vertices, axis=0)
        arm = vertices - centre
        turn = distance / jnp.sqrt(jnp.mean(jnp.sum(arm**2, axis=-1)))
        return jnp.concatenate([shifted, (centre + _rotated(arm, turn))[None]])


def _boundary_type_error(one: AbstractBoundary, other: AbstractBoundary) -> TypeError:
    name = describe(other) if not isinstance(other, AbstractBoundary) else type(other).__name__
    return TypeError(
        f"Argument `boundary` must be of the class {type(one).__name__}, like that of the tissue, but is "
        f"{name}."
    )


def _pivot(
    vertices: Float[Array, "vertices 2"], pinned: Bool[Array, " vertices"] | None
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """The centre of rotation (the centroid, or the only pinned vertex), and whether rotations are free."""
    if pinned is None:
        return jnp.mean(vertices, axis=0), jnp.array(True)
    n_pinned = jnp.sum(pinned)
    included = jnp.where(n_pinned > 0, pinned, True)[:, None]
    centre = jnp.sum(jnp.where(included, vertices, 0), axis=0) / jnp.sum(included)
    return centre, n_pinned <= 1


def _rotated(p: Float[Array, "n 2"], angle: Float[Array, ""]) -> Float[Array, "n 2"]:
    """Vectors rotated counter-clockwise."""
    perpendicular = jnp.stack([-p[:, 1], p[:, 0]], axis=-1)
    return jnp.cos(angle) * p + jnp.sin(angle) * perpendicular


def _translation_drift(
    displacement: Float[Array, "vertices 2"], pinned: Bool[Array, " vertices"] | None
) -> Float[Array, "2"]:
    drift = jnp.mean(displacement, axis=0) * jnp.sqrt(1.0 * displacement.shape[0])
    return drift if pinned is None else jnp.where(jnp.any(pinned), 0, drift)
