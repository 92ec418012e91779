"""Pairs of sides of a face: whether they cross, and their distance."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.minimum_maximum import maximum, minimum
from vertax._base.plane import cross, dot
from vertax._base.reciprocal import inverse_square_root

# A side is a row of an array: its start, its chord and, in tissues with arcs, its angle α, positive if it
# bulges to the right (out of the face). With the unit vector e along the chord of length c and the unit
# vector n to its left, the points x of its circle, relative to its start, satisfy
#
#     F(x) = κ/2 |x|² - g·x = 0,    κ = 2 sin(α) / c,    g = sin(α) e + cos(α) n.
#
# For α = 0 this is the line of the chord; no radius becomes large. The signed distance from the circle is
# 2 F / (1 + √(1 + 2 κ F)).
Sides = Float[Array, "sides parts"]


def sides_cross(one: Sides, other: Sides, joined: Bool[Array, ""]) -> Bool[Array, " sides"]:
    """Whether two sides have a common point other than a common end.

    **Arguments:**

    - `joined`: whether `other` begins at the end of `one`.
    """
    straight = _segments_cross(one, other) & ~joined
    if one.shape[-1] == 4:
        return straight
    bent = jnp.maximum(jnp.abs(one[:, 4]), jnp.abs(other[:, 4])) > 1e-6
    return jnp.where(bent, _arcs_cross(one, other, joined), straight)


def _segments_cross(one: Sides, other: Sides) -> Bool[Array, " sides"]:
    p, u, q, v = one[:, :2], one[:, 2:4], other[:, :2], other[:, 2:4]
    w = q - p
    apart = (cross(u, w) * cross(u, w + v) >= 0) | (cross(v, w) * cross(v, w - u) >= 0)
    # By rounding, collinear sides (as in a row of bricks) may seem to cross: compare their bounding boxes.
    low, high = jnp.minimum(p, p + u), jnp.maximum(p, p + u)
    below, above = jnp.minimum(q, q + v), jnp.maximum(q, q + v)
    return ~apart & jnp.all((low <= above) & (below <= high), axis=-1)


def _arcs_cross(one: Sides, other: Sides, joined: Bool[Array, ""]) -> Bool[Array, " sides"]:
    """`sides_cross` for arcs: two circles intersect on the line κ' F = κ F'."""
    circles = [jnp.column_stack(circle_of(side[:, 2:4], side[:, 4])) for side in (one, other)]
    first = (jnp.abs(circles[0][:, 0]) >= jnp.abs(circles[1][:, 0]))[:, None]
    a, b = jnp.where(first, one, other), jnp.where(first, other, one)
    (k1, g1), (k2, g2) = (
        (rows[:, 0], rows[:, 1:])
        for rows in (jnp.where(first, *circles), jnp.where(first, *reversed(circles)))
    )
    w = b[:, :2] - a[:, :2]
    normal = (k2 / jnp.where(k1 == 0, 1, k1))[:, None] * g1 - k2[:, None] * w - g2
    level = -(0.5 * k2 * dot(w, w) + dot(w, g2))
    size = jnp.maximum(dot(normal, normal), jnp.finfo(w.dtype).tiny)
    foot = normal * (level / size)[:, None]
    along = jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1) / jnp.sqrt(size)[:, None]
    half, rest = dot(along, g1), 0.5 * k1 * dot(foot, foot) - dot(foot, g1)
    squared = half**2 - 2 * k1 * rest
    root = half + jnp.where(half < 0, -1, 1) * jnp.sqrt(jnp.maximum(squared, 0))
    nonzero = lambda x: jnp.where(x == 0, jnp.finfo(w.dtype).tiny, x)
    # Joined sides have a common end, which does not count.
    joint = other[:, :2] - a[:, :2]
    nearby = 4 * jnp.finfo(w.dtype).eps ** 0.5 * jnp.sqrt(dot(a[:, 2:4], a[:, 2:4]))
    crosses = jnp.zeros(squared.shape, bool)
    for position in (root / nonzero(k1), 2 * rest / nonzero(root)):
        x = foot + position[:, None] * along
        away = ~joined | (jnp.sqrt(dot(x - joint, x - joint)) > nearby)
        crosses |= away & on_arc(a[:, 2:4], a[:, 4], x) & on_arc(b[:, 2:4], b[:, 4], x - w)
    return crosses & (squared > 0)


def on_arc(
    chord: Float[Array, "*n 2"], angle: Float[Array, "*n"], x: Float[Array, "*n 2"]
) -> Bool[Array, "*n"]:
    """Whether a point of the circle, relative to the start of the side, is on the arc."""
    squared, along, aside = dot(chord, chord), dot(chord, x), cross(chord, x)
    # The arc is the part of its circle on one side of the chord. A flat arc is close to the chord.
    flat = (along > 0) & (along < squared) & (jnp.abs(aside) < squared)
    return jnp.where(jnp.abs(angle) < 0.5, flat, aside * angle < 0)


class Circle(NamedTuple):
    """Curvature κ and vector g of the circle of each side."""

    curvature: Float[Array, "*n"]
    normal: Float[Array, "*n 2"]


def circle_of(chord: Float[Array, "*n 2"], angle: Float[Array, "*n"]) -> Circle:
    """The circles of sides that may be arcs; κ = 0 for straight sides."""
    squared = dot(chord, chord)
    inverse = inverse_square_root(jnp.where(squared > 0, squared, 1))
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    along = chord * inverse[..., None]
    left = jnp.stack([-along[..., 1], along[..., 0]], axis=-1)
    return Circle(2 * sine * inverse, sine[..., None] * along + cosine[..., None] * left)


@jax.custom_jvp
def squared_distance_to_segment(
    point: Float[Array, "sides 2"], side: Sides
) -> Float[Array, " sides"]:
    """Squared distance of a point from each straight side."""
    offset, _ = _offset_from_segment(point, side)
    return dot(offset, offset)


# By the envelope theorem the derivative is that at a fixed nearest point of the side.
@squared_distance_to_segment.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Float[Array, " sides"], Float[Array, " sides"]]:
    (offset, fraction), (change, moved) = _offset_from_segment(*primals), tangents
    change = change - moved[:, :2] - fraction[:, None] * moved[:, 2:4]
    return dot(offset, offset), 2 * dot(offset, change)


def _offset_from_segment(
    point: Float[Array, "sides 2"], side: Sides
) -> tuple[Float[Array, "sides 2"], Float[Array, " sides"]]:
    """Vector from the nearest point of each side, and the position of that point (0 to 1) on the side."""
    first, chord = point - side[:, :2], side[:, 2:4]
    squared = dot(chord, chord)
    fraction = minimum(maximum(dot(first, chord) / jnp.where(squared > 0, squared, 1), 0), 1)
    return first - fraction[:, None] * chord, fraction
