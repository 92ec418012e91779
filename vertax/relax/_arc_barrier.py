"""The barrier between sides that may be arcs."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.minimum_maximum import maximum, minimum
from vertax._base.plane import cross, dot
from vertax._base.reciprocal import inverse_square_root, reciprocal
from vertax._base.sums import total
from vertax.mesh._sides import Circle, Sides, circle_of, on_arc
from vertax.relax._barrier import Expansion, differentiated, profile
from vertax.relax._pair_barrier import AbstractPairBarrier

_FLAT = 0.01
"""Arcs of at most this angle, in radians, do not bulge: then their corners are as near as they are."""
_ENDS = 0.1
"""The part of a chord next to an end where corners count instead of the bulge."""


class ArcBarrier(AbstractPairBarrier):
    r"""The barrier between sides that may be arcs: the sum of two terms for each pair.

    1. The start of one side against the other side, as for straight sides.
    2. The first side against the second one. If the second follows on the first, $s = (\sin\theta / m)^2$
        with the angle $\theta$ of the face between them. Otherwise $s = D^2 / d_0^2$ with the distance $D$
        between the circles, for an arc that bulges into the face. Where the nearest points are at ends of
        sides, corners are as near, and the weight of this term decreases smoothly to 0.

    A corner is a circle of radius 0, so that both distances have one formula.
    """

    def vectors(self, positions: Float[Array, "2 pairs 5"]) -> Float[Array, "8 pairs"]:
        """The start of one side from that of the other, and chord and angle of both."""
        one, other = positions
        return jnp.concatenate([one[:, :2] - other[:, :2], one[:, 2:], other[:, 2:]], axis=-1).T

    def forces(self, slopes: Float[Array, "8 pairs"]) -> Float[Array, "2 pairs 5"]:
        """The transpose of `vectors`."""
        offset, one, other = slopes[:2], slopes[2:5], slopes[5:]
        return jnp.stack([jnp.concatenate([offset, one]).T, jnp.concatenate([-offset, other]).T])

    def expansion(self, vectors: Float[Array, "8 pairs"]) -> Expansion:
        """The energies of pairs and their derivatives."""

        def energies(vectors: Array) -> Array:
            near, weight = self._terms(vectors, self.after, self.before)
            # (A side that is far away may be at an infinite distance.)
            near = jnp.where(self.valid & (near < 1), near, 1)
            return self.strength * total(weight * profile(near).value)

        return differentiated(energies, vectors)

    def nearness(
        self, one: Sides, other: Sides, after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        near, _ = self._terms(self.vectors(jnp.stack([one, other])), after, before)
        return jnp.minimum(*near)

    def _terms(
        self, vectors: Float[Array, "8 n"], after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"]]:
        """Squared distance over squared range of both terms, and their weights."""
        x, chord, angle = vectors[:2].T, _pairs(vectors[2:4].T, vectors[5:7].T), vectors[4::3]
        circles = circle_of(chord, angle)
        squared = dot(chord, chord)
        bulging = angle[0] < -_FLAT
        radius = -reciprocal(jnp.where(bulging, circles.curvature[0], -1))
        to_centre = -radius[:, None] * circles.normal[0]
        # For the corner and for the bulge.
        both = lambda rows: jnp.broadcast_to(rows[1], rows.shape)
        other = Circle(*map(both, circles))
        distance, direction, proper = _from_circle(_pairs(x, x + to_centre), other)
        foot = _pairs(x, x + to_centre) + distance[..., None] * direction
        touches = proper & on_arc(both(chord), both(angle), foot)

        last = x - chord[1]
        ends = minimum(dot(x, x), dot(last, last))
        of_corner = jnp.where(touches[0], distance[0] ** 2, ends)
        gap = distance[1] - radius
        nearest = to_centre + radius[:, None] * direction[1]
        facing = bulging & (gap > 0) & touches[1] & on_arc(chord[0], angle[0], nearest)
        inner = self._inner(chord, _pairs(nearest, foot[1]), facing)
        weight = _smooth_step(-angle[0] / _FLAT - 1) * inner

        arriving = circles.normal[0] - circles.curvature[0][:, None] * chord[0]
        sine, cosine = -cross(circles.normal[1], arriving), -dot(circles.normal[1], arriving)
        acute = (cosine > 0) & (sine > 0)
        # (Only the next side has a common end with this one.)
        arms = _pairs(ends, minimum(squared[0], squared[1]))
        inverse = self.inverse_squared_range(arms, _pairs(after | before, after))
        of_angle = jnp.where(acute, (sine / self.slope) ** 2, jnp.inf)
        of_bulge = jnp.where(facing, jnp.where(facing, gap, 1) ** 2 * inverse[1], jnp.inf)
        near = _pairs(of_corner * inverse[0], jnp.where(after, of_angle, of_bulge))
        weight = _pairs(jnp.ones_like(weight), jnp.where(after, 1, jnp.where(facing, weight, 0)))
        return near, weight * reciprocal(inverse)

    def _inner(
        self, chord: Float[Array, "2 n 2"], x: Float[Array, "2 n 2"], where: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        """1 if points of two arcs are in their inner parts, decreasing to 0 at the ends."""
        x, chord = jnp.where(where[:, None], x, 1), jnp.where(where[:, None], chord, 3)
        last, squared = x - chord, dot(chord, chord)
        inverse = inverse_square_root(squared)
        reach = minimum(_ENDS * squared * inverse, self.distance)
        product = dot(x, x) * dot(last, last)
        height = (
            product * inverse_square_root(product) * inverse
        )  # above the chord, of a right angle
        return jnp.prod(_smooth_step(height * reciprocal(reach)), axis=0)


def _from_circle(
    x: Float[Array, "*n 2"], circle: Circle
) -> tuple[Float[Array, "*n"], Float[Array, "*n 2"], Bool[Array, "*n"]]:
    """Distance of points from a circle, positive on its inner side; the direction to it.

    Neither is defined at its centre, where the last result is False.
    """
    curvature, normal = circle
    value = 0.5 * curvature * dot(x, x) - dot(normal, x)
    squared = 1 + 2 * curvature * value
    proper = squared > 0
    squared = jnp.where(proper, squared, 1)
    inverse = inverse_square_root(squared)
    distance = -2 * value * reciprocal(1 + squared * inverse)
    return distance, (curvature[..., None] * x - normal) * inverse[..., None], proper


def _smooth_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """6x⁵ - 15x⁴ + 10x³ between 0 and 1; constant outside; twice differentiable."""
    x = minimum(maximum(x, 0), 1)
    return (10 + (6 * x - 15) * x) * x**3


def _pairs(a: Array, b: Array) -> Array:
    return jnp.stack([a, b])
