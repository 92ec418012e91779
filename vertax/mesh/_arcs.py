"""Circular arcs over their chords."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import zeta

from vertax._base.minimum_maximum import maximum

# An arc is given by its chord c and the angle α between the chord and the tangent at its ends (half
# the angle that it spans), positive if it bulges to the right of the chord. Then c = 2 R sin α, and
#
#     length                     c f(α),    f = α / sin α
#     area right of the chord    c² g(α),   g = (α - sin α cos α) / (4 sin² α)
#     moment of that area        c³ h(α),   h = 1/12 - g cot(α) / 2     (about the chord)
#
# All three are smooth at α = 0, where these forms are 0/0. Below an angle of 0.5 their power series
# are summed; they converge up to π, so a dozen terms give every digit of value and derivatives. With
# the series of the cotangent, α cot α = 1 - 2 Σ ζ(2k) (α/π)^2k, and g = -(1/4) d(α cot α)/dα:
#
#     f = 1 + 2 Σ η(2k) (α/π)^2k,   η(s) = (1 - 2^(1-s)) ζ(s),        g = Σ k ζ(2k) α^(2k-1) / π^2k.
_TERMS = np.arange(1, 15)
_ZETA = zeta(2.0 * _TERMS) / np.pi ** (2.0 * _TERMS)
_LENGTH = np.concatenate([[1.0], 2 * (1 - 2.0 ** (1 - 2 * _TERMS)) * _ZETA])
_AREA = _TERMS * _ZETA  # times α
_MOMENT = -0.5 * np.convolve(_AREA, np.concatenate([[1.0], -2 * _ZETA]))[: len(_TERMS)]
_MOMENT[0] = 0.0  # 1/12 cancels exactly
_SERIES_BELOW = 0.5


class Arcs(eqx.Module):
    """The angles of the edges of a tissue.

    **Arguments:**

    - `angles`: of each edge, in radians; only those of arcs count.
    - `length`: what makes an angle a degree of freedom like a position.
    - `inner`: whether edges between two cells are arcs, or only those on the outline.
    """

    angles: Float[Array, " edges"]
    length: Float[Array, ""]
    inner: bool = eqx.field(static=True, kw_only=True)

    @property
    def scaled(self) -> Float[Array, " edges"]:
        """The angles as degrees of freedom."""
        return self.angles * self.length


class _Function(NamedTuple):
    """A function of angles by its power series near 0 and by a closed form elsewhere."""

    # In α²; of an odd function over α. Python's numbers leave float32 alone.
    series: tuple[float, ...]
    closed: Callable[[Array], Array]
    odd: bool

    def __call__(self, angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        return _evaluate(self, angle)

    @property
    def derivative(self) -> _Function:
        powers = 2 * np.arange(len(self.series)) + self.odd
        slopes = tuple((powers * np.array(self.series)).tolist())
        slope = lambda x: jax.jvp(self.closed, (x,), (jnp.ones_like(x),))[1]
        return _Function(slopes if self.odd else slopes[1:], slope, not self.odd)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate(function: _Function, angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    # The `where` is doubled: the branch that is not taken gets an argument at which it is defined.
    near = jnp.abs(angle) < _SERIES_BELOW
    squared = jnp.where(near, angle, 0) ** 2
    *lower, highest = function.series
    sum_ = jnp.full_like(angle, highest)
    for coefficient in reversed(lower):
        sum_ = sum_ * squared + coefficient
    closed = function.closed(jnp.where(near, 1, angle))
    return jnp.where(near, angle * sum_ if function.odd else sum_, closed)


# The series of the derivative takes a third of what the derivative of the series does.
@_evaluate.defjvp
def _(function: _Function, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (angle,), (change,) = primals, tangents
    return _evaluate(function, angle), _evaluate(function.derivative, angle) * change


length_factor = _Function(tuple(_LENGTH.tolist()), lambda a: a / jnp.sin(a), odd=False)
"""Length of an arc over that of its chord."""

area_factor = _Function(
    tuple(_AREA.tolist()),
    lambda a: (a - jnp.sin(a) * jnp.cos(a)) / (4 * jnp.sin(a) ** 2),
    odd=True,
)
"""Area between an arc and its chord over the square of the chord, positive on its right."""

moment_factor = _Function(
    tuple(_MOMENT.tolist()),
    lambda a: 1 / 12 - (a - jnp.sin(a) * jnp.cos(a)) * jnp.cos(a) / (8 * jnp.sin(a) ** 3),
    odd=False,
)
"""First moment of that area about the chord over the cube of the chord; towards the right."""

# At π an arc is a whole circle over a chord of length 0, and beyond the formulas describe something
# else, of negative length, to which an overlong step of a minimiser must not lead. So angles are
# bounded: from the largest free angle on, d beyond it becomes w d / √(w² + d²), where w is what is left
# up to π. That has the slope 1 and no curvature at d = 0, and every angle is that of an arc. (Lengths and
# areas grow like d² and d⁴: the way back stays steep.)
LARGEST_FREE_ANGLE = 0.98 * np.pi


def bounded(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The angle itself up to 0.98 π, and always less than π."""
    beyond = maximum(jnp.abs(angle) - LARGEST_FREE_ANGLE, 0)
    width = np.pi - LARGEST_FREE_ANGLE
    limited = LARGEST_FREE_ANGLE + width * beyond / jnp.sqrt(width**2 + beyond**2)
    return jnp.where(beyond > 0, jnp.sign(angle) * limited, angle)


def arc_points(
    start: Float[Array, "arcs 2"],
    chord: Float[Array, "arcs 2"],
    angle: Float[Array, " arcs"],
    fractions: Float[Array, " points"],
) -> Float[Array, "arcs points 2"]:
    """Points on arcs at some fractions (0 to 1) of their length from the start."""
    # At s from -1 to 1, in units of half the chord: sin(α s) / sin α along it, and to its right
    # (cos(α s) - cos α) / sin α, written as products of sin(x)/x, which are smooth at 0.
    s = 2 * fractions - 1
    a = angle[:, None]
    factor = length_factor(a)
    along = s * _sinc(a * s) * factor
    aside = 0.5 * a * (1 - s**2) * _sinc(0.5 * a * (1 + s)) * _sinc(0.5 * a * (1 - s)) * factor
    half = 0.5 * chord[:, None, :]
    right = jnp.stack([half[..., 1], -half[..., 0]], axis=-1)
    return start[:, None, :] + half + along[..., None] * half + aside[..., None] * right


def _sinc(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.sinc(x / np.pi)


def angle_of_area(
    area: Float[np.ndarray, " arcs"], chord: Float[np.ndarray, " arcs"]
) -> Float[np.ndarray, " arcs"]:
    """The angle at which an arc holds a (signed) area over its chord, at most 0.9 π."""
    # Bisection: the area grows with the angle, and this runs once, when a tissue is made.
    wanted = np.abs(area)
    low, high = np.zeros_like(wanted), np.full_like(wanted, 0.9 * np.pi)
    for _ in range(60):
        middle = 0.5 * (low + high)
        sine = np.sin(middle)
        more = chord**2 * (middle - sine * np.cos(middle)) < 4 * sine**2 * wanted
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.sign(area) * low
