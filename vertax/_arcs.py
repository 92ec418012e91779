"""Circular arcs over their chords."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import zeta

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

LARGEST_ANGLE = 0.98 * np.pi
"""Up to here the three functions are exact. At π an arc is a whole circle over a chord of length 0."""


class _Function(NamedTuple):
    # All numbers are Python's, which leave float32 as it is.
    series: tuple[float, ...]  # in α²; of an odd function over α
    closed: Callable[[Array], Array]
    odd: bool
    beyond: tuple[float, float, float]
    """Value and two derivatives at the largest angle."""

    def __call__(self, angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        # An overlong step of a minimiser may carry an angle past π, where the formulas describe
        # something else, of negative length. From the largest angle on a parabola goes on as steeply
        # and with the same curvature, so that the way back leads downhill. Each `where` is doubled: the
        # branch that is not taken gets an argument at which it has derivatives.
        size = jnp.abs(angle)
        near, far = size < _SERIES_BELOW, size > LARGEST_ANGLE
        squared = jnp.where(near, angle, 0) ** 2
        *lower, highest = self.series
        sum_ = jnp.full_like(angle, highest)
        for coefficient in reversed(lower):
            sum_ = sum_ * squared + coefficient
        middle = self.closed(jnp.where(near | far, 1, size))
        over = jnp.where(far, size - LARGEST_ANGLE, 0)
        value, slope, curvature = self.beyond
        outer = jnp.where(far, value + over * (slope + 0.5 * curvature * over), middle)
        if self.odd:
            return jnp.where(near, angle * sum_, jnp.sign(angle) * outer)
        return jnp.where(near, sum_, outer)


_SIN, _COS = float(np.sin(LARGEST_ANGLE)), float(np.cos(LARGEST_ANGLE))
_BULGE = _SIN - LARGEST_ANGLE * _COS  # f' sin² = 2 g' sin³
_f = LARGEST_ANGLE / _SIN
_g = (LARGEST_ANGLE - _SIN * _COS) / (4 * _SIN**2)
_g1 = _BULGE / (2 * _SIN**3)
_g2 = (LARGEST_ANGLE * _SIN**2 - 3 * _COS * _BULGE) / (2 * _SIN**4)
_cot, _cot1, _cot2 = _COS / _SIN, -1 / _SIN**2, 2 * _COS / _SIN**3

length_factor = _Function(
    tuple(_LENGTH.tolist()),
    lambda a: a / jnp.sin(a),
    False,
    (_f, _BULGE / _SIN**2, (LARGEST_ANGLE * _SIN**2 - 2 * _COS * _BULGE) / _SIN**3),
)
"""Length of an arc over that of its chord."""

area_factor = _Function(
    tuple(_AREA.tolist()),
    lambda a: (a - jnp.sin(a) * jnp.cos(a)) / (4 * jnp.sin(a) ** 2),
    True,
    (_g, _g1, _g2),
)
"""Area between an arc and its chord over the square of the chord, positive on its right."""

moment_factor = _Function(
    tuple(_MOMENT.tolist()),
    lambda a: 1 / 12 - (a - jnp.sin(a) * jnp.cos(a)) * jnp.cos(a) / (8 * jnp.sin(a) ** 3),
    False,
    (
        1 / 12 - _g * _cot / 2,
        -(_g1 * _cot + _g * _cot1) / 2,
        -(_g2 * _cot + 2 * _g1 * _cot1 + _g * _cot2) / 2,
    ),
)
"""First moment of that area about the chord over the cube of the chord; towards the right."""


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
