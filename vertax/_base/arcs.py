"""Length, area and moment of circular arcs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import zeta

from vertax._base.minimum_maximum import maximum

# An arc has a chord c and the angle α between the chord and the tangents at its ends (half the central
# angle), positive if it bulges to the right of the chord. Then c = 2 R sin α, and
#
#     length                     c f(α),    f = α / sin α
#     area right of the chord    c² g(α),   g = (α - sin α cos α) / (4 sin² α)
#     moment of that area        c³ h(α),   h = 1/12 - g cot(α) / 2     (about the chord)
#
# All three are smooth at α = 0, where these formulas are 0/0. For |α| < 0.5 their power series are
# summed; the series converge for |α| < π, so 14 terms give values and derivatives to rounding. With the
# series of the cotangent, α cot α = 1 - 2 Σ ζ(2k) (α/π)^2k, and g = -(1/4) d(α cot α)/dα:
#
#     f = 1 + 2 Σ η(2k) (α/π)^2k,   η(s) = (1 - 2^(1-s)) ζ(s),        g = Σ k ζ(2k) α^(2k-1) / π^2k.
_TERMS = np.arange(1, 15)
_ZETA = zeta(2.0 * _TERMS) / np.pi ** (2.0 * _TERMS)
_LENGTH = np.concatenate([[1.0], 2 * (1 - 2.0 ** (1 - 2 * _TERMS)) * _ZETA])
_AREA = _TERMS * _ZETA  # times α
_MOMENT = -0.5 * np.convolve(_AREA, np.concatenate([[1.0], -2 * _ZETA]))[: len(_TERMS)]
_MOMENT[0] = 0.0  # 1/12 - 1/12
_SERIES_BELOW = 0.5


class _Function(NamedTuple):
    """An even or odd function of an angle: a power series near 0, a closed form elsewhere."""

    # Coefficients in α², of an odd function after division by α. Python floats, so that float32 stays.
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
    # Double `where`: the branch that is not taken gets an argument at which it is finite.
    near = jnp.abs(angle) < _SERIES_BELOW
    squared = jnp.where(near, angle, 0) ** 2
    *lower, highest = function.series
    sum_ = jnp.full_like(angle, highest)
    for coefficient in reversed(lower):
        sum_ = sum_ * squared + coefficient
    closed = function.closed(jnp.where(near, 1, angle))
    return jnp.where(near, angle * sum_ if function.odd else sum_, closed)


# The series of the derivative costs a third of the derivative of the series.
@_evaluate.defjvp
def _(function: _Function, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (angle,), (change,) = primals, tangents
    return _evaluate(function, angle), _evaluate(function.derivative, angle) * change


length_factor = _Function(tuple(_LENGTH.tolist()), lambda a: a / jnp.sin(a), odd=False)
"""f(α): length of an arc / length of its chord."""

area_factor = _Function(
    tuple(_AREA.tolist()),
    lambda a: (a - jnp.sin(a) * jnp.cos(a)) / (4 * jnp.sin(a) ** 2),
    odd=True,
)
"""g(α): area between an arc and its chord / chord², positive on the right of the chord."""

moment_factor = _Function(
    tuple(_MOMENT.tolist()),
    lambda a: 1 / 12 - (a - jnp.sin(a) * jnp.cos(a)) * jnp.cos(a) / (8 * jnp.sin(a) ** 3),
    odd=False,
)
"""h(α): first moment of that area about the chord / chord³, positive on the right of the chord."""

# At α = π an arc is a full circle over a chord of length 0; for α > π the length is negative. So that no
# step of a minimiser gives α ≥ π, angles α = α₁ + d above α₁ = 0.98 π are replaced by
#
#     α₁ + w d / √(w² + d²),    w = π - α₁,
#
# with slope 1 and curvature 0 at d = 0. (Lengths grow like d², areas like d⁴: the gradient stays large.)
LARGEST_FREE_ANGLE = 0.98 * np.pi


def bounded(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The identity for |angle| ≤ 0.98 π; smoothly limited to less than π above."""
    excess = maximum(jnp.abs(angle) - LARGEST_FREE_ANGLE, 0)
    width = np.pi - LARGEST_FREE_ANGLE
    limited = LARGEST_FREE_ANGLE + width * excess / jnp.sqrt(width**2 + excess**2)
    return jnp.where(excess > 0, jnp.sign(angle) * limited, angle)


def arc_points(
    start: Float[Array, "arcs 2"],
    chord: Float[Array, "arcs 2"],
    angle: Float[Array, " arcs"],
    fractions: Float[Array, " points"],
) -> Float[Array, "arcs points 2"]:
    """Points on arcs at given fractions (0 to 1) of their length from the start."""
    # At s in [-1, 1], in units of half the chord: sin(α s) / sin α along the chord and
    # (cos(α s) - cos α) / sin α to its right, written as products of sin(x)/x, which are smooth at 0.
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
    """The angle of an arc with a given (signed) area over its chord, at most 0.9 π."""
    # Bisection: the area increases with the angle. This runs once, when a tissue is created.
    target = np.abs(area)
    low, high = np.zeros_like(target), np.full_like(target, 0.9 * np.pi)
    for _ in range(60):
        middle = 0.5 * (low + high)
        sine = np.sin(middle)
        too_small = chord**2 * (middle - sine * np.cos(middle)) < 4 * sine**2 * target
        low, high = np.where(too_small, middle, low), np.where(too_small, high, middle)
    return np.sign(area) * low
