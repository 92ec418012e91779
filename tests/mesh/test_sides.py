"""Distances between pairs of sides."""

import jax.numpy as jnp
import numpy as np
from brute_force_overlaps import side_points
from hypothesis import given, settings, strategies as st
from scipy.spatial.distance import cdist

from vertax.mesh._sides import bulge_gap, circle_of

REACH = jnp.array(1e-3)


def side(start, end, angle):
    return jnp.array([[*start, *(np.array(end) - start), angle]])


def gap_between(one, other):
    gap, weight = bulge_gap(one, other, (circle_of(one), circle_of(other)), REACH)
    return float(gap[0]), float(weight[0])


@settings(max_examples=200, deadline=None)
@given(
    bulge=st.floats(0.05, 2.5),
    angle=st.one_of(st.just(0.0), st.floats(-2.5, 2.5), st.floats(-1e-4, 1e-4)),
    middle=st.tuples(st.floats(0.1, 0.9), st.floats(0.01, 2)),
    half=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
def test_bulge_gap_is_the_minimum_distance(bulge, angle, middle, half):
    start, end = np.subtract(middle, half), np.add(middle, half)
    one, other = side([0.0, 0.0], [1.0, 0.0], -bulge), side(start, end, angle)
    gap, weight = gap_between(one, other)
    if weight == 0:
        return
    points = side_points(np.zeros(2), np.array([1.0, 0.0]), -bulge, 800)
    others = (
        np.linspace(start, end, 800) if abs(angle) < 1e-9 else side_points(start, end, angle, 800)
    )
    np.testing.assert_allclose(gap, cdist(points, others).min(), rtol=1e-2, atol=1e-4)


def test_bulge_gap_to_a_straight_or_flat_side():
    one = side([0.0, 0.0], [1.0, 0.0], -0.5 * np.pi)  # a semicircle above its chord
    for angle in (0.0, 1e-5, -1e-5):
        gap, weight = gap_between(one, side([1.5, 0.6], [-0.5, 0.6], angle))
        np.testing.assert_allclose((gap, weight), (0.1, 1), atol=1e-4)
