"""The barrier between sides that may be arcs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brute_force_overlaps import side_points
from hypothesis import given, settings, strategies as st
from scipy.spatial.distance import cdist

from vertax.relax._arc_barrier import ArcBarrier
from vertax.relax._barrier import barrier_energy

RANGE = 1e-3


def side(start, end, angle):
    return jnp.array([[*start, *(np.array(end) - start), angle]])


def barrier_of(*, after=False, before=False, distance=RANGE):
    array = lambda flag: jnp.array([flag])
    slope, strength = 5 * distance, 1 / distance**2
    return ArcBarrier(
        *(jnp.array(float(x)) for x in (distance, slope, strength)),
        *map(array, (after, before, True)),
    )


def distance_between(one, other):
    unjoined = jnp.array([False])
    return RANGE * float(jnp.sqrt(barrier_of().nearness(one, other, unjoined, unjoined)[0]))


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(
    bulge=st.floats(0.05, 2.5),
    angle=st.one_of(st.just(0.0), st.floats(-2.5, 2.5), st.floats(-1e-4, 1e-4)),
    middle=st.tuples(st.floats(0.1, 0.9), st.floats(0.01, 2)),
    half=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
def test_nearness_is_the_minimum_distance(bulge, angle, middle, half):
    start, end = np.subtract(middle, half), np.add(middle, half)
    one, other = side([0.0, 0.0], [1.0, 0.0], -bulge), side(start, end, angle)
    points = side_points(np.zeros(2), np.array([1.0, 0.0]), -bulge, 800)
    straight = abs(angle) < 1e-9
    inner = np.linspace(start, end, 800) if straight else side_points(start, end, angle, 800)
    others = np.vstack([inner, end])
    distances = cdist(points, others)
    distance, nearest = distance_between(one, other), distances.min()
    assert distance > nearest - 1e-2 * nearest - 2e-3  # (the points are 0.003 apart)
    # (Otherwise the bulge is on the other side, or corners of the other side are nearest: another pair.)
    clearly_below = lambda other: other > 1.01 * distance + 1e-3
    bulge_counts = clearly_below(distances[0].min())
    apart = nearest > 5e-3
    if bulge_counts and apart and clearly_below(distances[:, [0, -1]].min()):
        np.testing.assert_allclose(distance, nearest, rtol=1e-2, atol=1e-4)


def test_nearness_of_a_straight_or_flat_side():
    one = side([0.0, 0.0], [1.0, 0.0], -0.5 * np.pi)  # a semicircle above its chord
    for angle in (0.0, 1e-5, -1e-5):
        distance = distance_between(one, side([1.5, 0.6], [-0.5, 0.6], angle))
        np.testing.assert_allclose(distance, 0.1, atol=1e-4)


CASES = {
    "corner against an arc": ([0.3, 0.15], [0.2, 1.0], 0.2, [1.0, 0.0], [0.0, 0.0], 0.2, {}),
    "corner against an end": ([1.02, 0.03], [2.0, 1.0], 0.2, [1.0, 0.0], [0.0, 0.0], 0.2, {}),
    "bulge against an arc": ([0.0, 0.0], [1.0, 0.0], -0.4, [1.0, 0.22], [0.0, 0.2], -0.1, {}),
    "bulge against a line": ([0.0, 0.0], [1.0, 0.0], -0.4, [1.0, 0.2], [0.0, 0.18], 0.0, {}),
    "angle": ([1.0, 0.0], [0.0, 0.0], 0.1, [0.0, 0.0], [1.0, -0.35], 0.1, {"after": True}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(CASES))
def test_derivatives_are_finite_differences(name):
    *ends, joined = CASES[name]
    barrier = barrier_of(distance=0.15, **joined)
    sides = jnp.stack([side(*ends[:3]), side(*ends[3:])])
    energy = lambda sides: barrier_energy(barrier, sides)
    direction = jax.random.normal(jax.random.key(0), sides.shape)
    along = lambda f, h: f(sides + h * direction)
    assert energy(sides) > 0
    h = 1e-5
    difference = (along(energy, h) - along(energy, -h)) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(jax.grad(energy)(sides), direction), difference, rtol=1e-6)
    slope = jax.grad(energy)
    product = jax.jvp(slope, (sides,), (direction,))[1]
    change = (along(slope, h) - along(slope, -h)) / (2 * h)
    np.testing.assert_allclose(product, change, rtol=1e-6, atol=1e-6 * float(jnp.abs(change).max()))
