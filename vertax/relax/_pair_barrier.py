"""The barrier between corners and sides of a face."""

from __future__ import annotations

import abc

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.minimum_maximum import minimum
from vertax._base.plane import dot
from vertax._base.reciprocal import reciprocal
from vertax._base.sums import total
from vertax.mesh._sides import Sides, squared_distance_to_segment
from vertax.relax._barrier import (
    AbstractBarrier,
    Expansion,
    composed,
    outer,
    profile,
)


class AbstractPairBarrier(AbstractBarrier):
    r"""The barrier between corners and sides that are near.

    A face overlaps itself where a corner reaches a side that it does not end. The energy of a corner at the
    distance $D$ from a side, with the range $d$ and $s = D^2 / d^2$, is

    $$-S d^2 (1 - s)^2 \ln s \quad \text{if } s < 1, \text{ otherwise } 0,$$

    twice differentiable, and nearly infinite at $s = 0$ (Li et al. 2020, doi:10.1145/3386569.3392425; the
    logarithm is that of $s + 10^{-4}$: an edge that shrinks to nothing may point anywhere, also along
    another side, and an infinite curvature would hide all others).

    Corners that share a short edge are near each other and not in contact. So for a side next to one of the
    corner's own sides the range is $1 / d^2 = 1 / d_0^2 + 1 / (m r)^2$ with the distance $r$ from their
    common end: there the angle counts.

    **Arguments:**

    - `distance`: the range $d_0$, a length.
    - `slope`: $m$.
    - `strength`: $S$, energy per length squared.
    - `after`, `before`: whether the side of each pair comes after that which leaves the corner, or before
        that which arrives there.
    - `valid`: which rows are pairs.
    """

    distance: Float[Array, ""]
    slope: Float[Array, ""]
    strength: Float[Array, ""]
    after: Bool[Array, " pairs"]
    before: Bool[Array, " pairs"]
    valid: Bool[Array, " pairs"]

    @abc.abstractmethod
    def nearness(
        self, one: Sides, other: Sides, after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        """Squared distance of the start of one side from another side over the squared range."""

    def inverse_squared_range(
        self, arm: Float[Array, "*shape"], joined: Bool[Array, "*shape"]
    ) -> Float[Array, "*shape"]:
        """$1 / d^2$, with the squared distance from a common end where two sides are joined."""
        joined &= arm > 0
        near_end = reciprocal(self.slope**2 * jnp.where(joined, arm, 1))
        return reciprocal(self.distance**2) + jnp.where(joined, near_end, 0)


class SegmentBarrier(AbstractPairBarrier):
    """The barrier between corners and straight sides, with derivatives in closed form."""

    def vectors(self, positions: Float[Array, "3 pairs 2"]) -> Float[Array, "4 pairs"]:
        """The corner from the start of the side, and the chord."""
        corner, start, end = positions
        return jnp.concatenate([corner - start, end - start], axis=-1).T

    def forces(self, slopes: Float[Array, "4 pairs"]) -> Float[Array, "3 pairs 2"]:
        """The transpose of `vectors`."""
        corner, end = slopes[:2].T, slopes[2:].T
        return jnp.stack([corner, -corner - end, end])

    def expansion(self, vectors: Float[Array, "4 pairs"]) -> Expansion:
        r"""The energies of pairs of straight sides, $S / I\, \varphi(u I)$, and their derivatives.

        With the corner at $x$ and the side from 0 to $c$, $u = |x - t c|^2$ is the squared distance,
        $v = |x - e c|^2$ that of the nearer end, and $I(v) = 1 / d_0^2 + b / v$ the inverse squared range.
        Inside of the side the derivative of $u$ by $t$ vanishes; at its ends $t$ is fixed.
        """
        x, c = vectors[:2], vectors[2:]
        squared = total(c * c)
        inverse_squared = 1 / jnp.where(squared > 0, squared, 1)
        along = total(x * c)
        t = jnp.clip(along * inverse_squared, 0, 1)
        inside = (t > 0) & (t < 1)
        e = (along > 0.5 * squared).astype(x.dtype)
        way, arm = x - t * c, x - e * c
        u, v = total(way * way), total(arm * arm)
        inverse_v = 1 / jnp.where(v > 0, v, 1)
        joined = (self.after | self.before) & (v > 0)
        b = jnp.where(joined, inverse_v / self.slope**2, 0)
        inverse = 1 / self.distance**2 + b
        square = 1 / inverse
        s = jnp.where(self.valid, u * inverse, 1)
        f = profile(s)
        # By I: of φ(u I) / I.
        by_i = (f.first * s - f.value) * square**2
        by_ii = (2 * f.value - 2 * f.first * s + f.second * s**2) * square**3
        d1, d2 = -b * inverse_v, 2 * b * inverse_v**2
        eye = jnp.eye(2, dtype=x.dtype)[:, :, None]

        def quadratic(t: Float[Array, " pairs"]) -> Float[Array, "4 4 pairs"]:
            """The second derivative of $|x - t c|^2$ for a fixed t."""
            first = jnp.concatenate([2 * eye * (1 + 0 * t), -2 * eye * t], axis=1)
            return jnp.concatenate([first, jnp.concatenate([-2 * eye * t, 2 * eye * t**2], axis=1)])

        turn = jnp.where(inside, 1, 0) * jnp.concatenate([-2 * c, 2 * t * c - 2 * way])
        scale = lambda f: self.strength * f
        return composed(
            scale(f.value * square),
            (scale(f.first), scale(by_i * d1)),
            (
                scale(f.second * inverse),
                scale(f.second * s * square * d1),
                scale(by_ii * d1**2 + by_i * d2),
            ),
            (
                jnp.concatenate([2 * way, -2 * t * way]),
                jnp.concatenate([2 * arm, -2 * e * arm]),
            ),
            (quadratic(t) - 0.5 * inverse_squared * outer(turn, turn), quadratic(e)),
        )

    def nearness(
        self, one: Sides, other: Sides, after: Bool[Array, " n"], before: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        first = one[:, :2] - other[:, :2]
        last = first - other[:, 2:4]
        arm = minimum(dot(first, first), dot(last, last))
        squared = squared_distance_to_segment(one[:, :2], other)
        return squared * self.inverse_squared_range(arm, after | before)
