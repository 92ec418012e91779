"""Length, area and moment of circular arcs, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertax._base import arcs as _arcs
from vertax._base.arcs import (
    LARGEST_FREE_ANGLE,
    angle_of_area,
    arc_points,
    area_factor,
    bounded,
    length_factor,
    moment_factor,
)

FUNCTIONS = [length_factor, area_factor, moment_factor]
ANGLES = [1e-8, 1e-3, 0.1, 0.4999, 0.5001, 1.0, np.pi / 2, 2.5, 3.0]


def by_quadrature(angle):
    """Length, area and moment of an arc with the chord from (0, 0) to (1, 0), positive below."""
    # In polar coordinates about the centre of the circle; 200 Gauss points are exact to rounding.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    phi, weights = angle * nodes, angle * weights
    radius = 1 / (2 * np.sin(angle))
    depth = radius * (np.cos(phi) - np.cos(angle))  # below the chord
    width = radius * np.cos(phi)  # dx / dphi
    return (
        radius * 2 * angle,
        np.sum(weights * depth * width),
        np.sum(weights * depth**2 / 2 * width),
    )


@pytest.mark.parametrize("angle", ANGLES[1:])
def test_factors_agree_with_quadrature(angle):
    for sign in (1, -1):
        values = [f(jnp.array(sign * angle)) for f in FUNCTIONS]
        length, area, moment = by_quadrature(angle)
        np.testing.assert_allclose(values, [length, sign * area, moment], rtol=2e-12, atol=1e-14)


def test_factors_of_a_semicircle():
    right = jnp.array(np.pi / 2)
    assert length_factor(right) == pytest.approx(np.pi / 2, rel=1e-15)
    assert area_factor(right) == pytest.approx(np.pi / 8, rel=1e-15)
    assert moment_factor(right) == pytest.approx(1 / 12, rel=1e-15)


def test_values_and_derivatives_at_angle_zero():
    # f = 1 + α²/6 + …, g = α/6 + α³/45 + …, h = α²/60 + …
    expected = {length_factor: (1, 0, 1 / 3, 0), area_factor: (0, 1 / 6, 0, 2 / 15)}
    expected[moment_factor] = (0, 0, 1 / 30, 0)
    for function, values in expected.items():
        for value in values:
            at = jax.jit(lambda angle, function=function: function(angle))
            assert at(0.0) == pytest.approx(value, abs=1e-15)
            function = jax.grad(function)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("angle", [0.0, *ANGLES, -0.3, -1.2, -2.8])
def test_derivatives_agree_with_finite_differences(function, angle):
    for derivative in (function, jax.grad(function)):
        h = 1e-5
        difference = (derivative(jnp.array(angle + h)) - derivative(jnp.array(angle - h))) / (2 * h)
        slope = jax.grad(derivative)(jnp.array(angle))
        assert slope == pytest.approx(float(difference), rel=1e-6, abs=1e-9)
        assert jax.jacfwd(derivative)(jnp.array(angle)) == pytest.approx(
            float(slope), rel=1e-13, abs=1e-15
        )


@pytest.mark.parametrize("function", FUNCTIONS)
def test_series_and_closed_form_agree_at_the_switch(function):
    for derivative in (function, jax.grad(function), jax.grad(jax.grad(function))):
        below, above = (derivative(jnp.array(_arcs._SERIES_BELOW + s * 1e-13)) for s in (-1, 1))
        assert below == pytest.approx(float(above), rel=1e-11)


def test_bounded_angles_are_monotone_and_below_pi():
    free = jnp.array([-3.0, -1e-9, 0.0, 2.0, LARGEST_FREE_ANGLE])
    np.testing.assert_array_equal(bounded(free), free)
    angles = jnp.linspace(3.0, 30.0, 500)
    limited = bounded(angles)
    assert (jnp.diff(limited) > 0).all()
    assert limited.max() < np.pi
    np.testing.assert_array_equal(bounded(-angles), -limited)
    for derivative in (bounded, jax.grad(bounded), jax.grad(jax.grad(bounded))):
        below, above = (derivative(jnp.array(LARGEST_FREE_ANGLE + s * 1e-9)) for s in (-1, 1))
        assert below == pytest.approx(float(above), abs=2e-5)
    # The gradient stays large at large angles.
    assert (jnp.diff(length_factor(limited)) > 0).all()
    assert jax.grad(lambda a: length_factor(bounded(a)))(jnp.array(6.0)) > 1e3


@pytest.mark.parametrize("angle", [-2.0, -1e-9, 0.0, 0.3, 1.5, 3.0])
def test_points_are_equally_spaced_on_the_arc(angle):
    start, chord = jnp.array([[1.0, 2.0]]), jnp.array([[0.6, -0.8]])
    points = arc_points(start, chord, jnp.array([angle]), jnp.linspace(0, 1, 101))[0]
    np.testing.assert_allclose(points[0], start[0], atol=1e-15)
    np.testing.assert_allclose(points[-1], (start + chord)[0], atol=1e-15)
    steps = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-10)
    # Towards the right of the chord: (-0.8, -0.6).
    aside = (points[50] - (start + chord / 2)[0]) @ jnp.array([-0.8, -0.6])
    assert aside == pytest.approx(0.5 * np.tan(angle / 2), rel=1e-12, abs=1e-15)
    slope = jax.jacfwd(lambda a: arc_points(start, chord, a[None], jnp.array([0.5]))[0, 0])
    assert jnp.isfinite(slope(jnp.array(angle))).all()


def test_angle_of_area_inverts_the_area():
    angles = np.array([-2.5, -0.2, 0.0, 1e-3, 0.7, 2.0])
    chords = np.array([0.1, 1.0, 2.0, 3.0, 0.5, 40.0])
    areas = chords**2 * np.asarray(area_factor(jnp.asarray(angles)))
    np.testing.assert_allclose(angle_of_area(areas, chords), angles, atol=1e-12)
    # The angle of an area over a chord of length 0 is limited to 0.9 π.
    assert angle_of_area(np.ones(1), np.zeros(1)) == pytest.approx(0.9 * np.pi)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_factors_in_float32(function):
    angles = np.array([-3.0, -0.51, -0.49, 0.0, 1e-4, 0.3, 1.0, 2.9], np.float32)
    single = function(jnp.asarray(angles))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, function(jnp.asarray(angles, float)), rtol=2e-5, atol=1e-7)
