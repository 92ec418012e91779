"""Surfaces: interpolation, tangents, and the errors of height maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

from vertax.surfaces import AbstractSurface, Cylinder, Graph, HeightMap, SphericalCap

RNG = np.random.default_rng(0)
HEIGHTS = RNG.normal(size=(9, 12))
PLACES = jnp.asarray(RNG.uniform(0.5, 3.5, size=(20, 2)))


class Saddle(AbstractSurface):
    height: float

    def points(self, x):
        return jnp.concatenate([x, self.height * x[..., :1] * x[..., 1:]], axis=-1)


SURFACES = {
    "cylinder": Cylinder(2.0),
    "cap": SphericalCap(6.0),
    "graph": Graph(lambda x: 0.5 * jnp.cos(x[0]) * jnp.sin(x[1])),
    "map": HeightMap(HEIGHTS, 0.5),
    "periodic map": HeightMap(HEIGHTS, 0.5, periodic=True),
    "own": Saddle(0.3),
}


def pixel_centres(shape, size):
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    return jnp.asarray(np.stack([columns + 0.5, rows + 0.5], axis=-1) * size)


def heights_of(surface, x):
    return np.asarray(surface.points(jnp.asarray(x))[..., 2])


@pytest.mark.parametrize("name", SURFACES)
def test_tangents_are_derivatives_of_points(name):
    surface = SURFACES[name]
    jacobian = surface.jacobian(PLACES)
    for k in range(2):
        direction = jnp.zeros_like(PLACES).at[:, k].set(1.0)
        difference = central_difference(surface.points, PLACES, direction, 1e-6)
        np.testing.assert_allclose(jacobian[..., k], difference, atol=1e-8)
    metric = jnp.einsum("nki,nkj->nij", jacobian, jacobian)
    np.testing.assert_allclose(surface.metric(PLACES), metric, atol=1e-13)
    np.testing.assert_allclose(surface.density(PLACES) ** 2, jnp.linalg.det(metric), rtol=1e-12)


@pytest.mark.parametrize("periodic", [False, True])
def test_height_maps_interpolate_the_pixels(periodic):
    surface = HeightMap(HEIGHTS, (0.5, 0.25), plane_distance=2.0, periodic=periodic)
    centres = pixel_centres(HEIGHTS.shape, np.array([0.25, 0.5]))
    np.testing.assert_allclose(heights_of(surface, centres), 2 * HEIGHTS, atol=1e-13)


@pytest.mark.thorough
def test_height_maps_converge_with_the_fourth_power_of_the_pixel_size():
    wave = lambda x: np.sin(np.pi * x[..., 0] / 4) * np.cos(np.pi * x[..., 1] / 4)
    x = RNG.uniform(0, 8, size=(500, 2))
    errors = []
    for n in (16, 32, 64):
        picture = wave(np.asarray(pixel_centres((n, n), 8 / n)))
        surface = HeightMap(picture, 8 / n, periodic=True)
        errors.append(np.abs(heights_of(surface, x) - wave(x)).max())
    assert np.all(np.diff(np.log2(errors)) < -3.7)


def test_a_tilted_picture_is_a_plane_also_outside_and_after_smoothing():
    plane = lambda x: 0.3 * x[..., 0] - 0.2 * x[..., 1] + 1
    surface = HeightMap(plane(pixel_centres((9, 12), 0.5)), 0.5, smoothing=0.7)
    x = RNG.uniform(-5, 12, size=(100, 2))
    np.testing.assert_allclose(heights_of(surface, x), plane(x), atol=1e-12)


@pytest.mark.parametrize("x", [0.5, 4.5, 11.5])
def test_height_maps_have_two_continuous_derivatives_at_pixels_and_at_the_rim(x):
    height = lambda x: SURFACES_AT_ONE.points(jnp.array([x, 3.3]))[2]
    for derivative in (height, jax.grad(height), jax.grad(jax.grad(height))):
        below, at, above = (float(derivative(x + step)) for step in (-1e-8, 0.0, 1e-8))
        assert below == pytest.approx(at, abs=1e-6)
        assert above == pytest.approx(at, abs=1e-6)


SURFACES_AT_ONE = HeightMap(HEIGHTS, 1.0)


@pytest.mark.thorough
def test_smoothing_attenuates_a_wave_as_documented():
    n, sigma, wavelength = 64, 0.8, 8.0
    x = pixel_centres((4, n), 0.25)
    wave = np.cos(2 * np.pi * np.asarray(x)[..., 0] / wavelength)
    surface = HeightMap(wave, 0.25, smoothing=sigma, periodic=True)
    factor = np.exp(-2 * np.pi**2 * sigma**2 / wavelength**2)
    # (The Gaussian is cut off at four standard deviations.)
    np.testing.assert_allclose(heights_of(surface, x), factor * wave, atol=1e-3)


@pytest.mark.thorough
def test_unknown_pixels_are_filled_from_those_around():
    x = np.asarray(pixel_centres((30, 30), 0.5))
    picture = 0.2 * x[..., 0] + 5
    holes = picture.copy()
    holes[10:16, 12:20] = np.nan
    holes[20, 3] = 0.0
    surface = HeightMap(holes, 0.5, unknown=0.0)
    np.testing.assert_allclose(heights_of(surface, x), picture, atol=0.4)
    kept = np.isfinite(holes) & (holes != 0)
    np.testing.assert_allclose(heights_of(surface, x)[kept], picture[kept], atol=1e-12)


def test_heights_are_differentiable():
    value = lambda heights: jnp.sum(HeightMap(heights, 0.5, smoothing=0.3).points(PLACES) ** 2)
    direction = RNG.normal(size=HEIGHTS.shape)
    slope = jnp.sum(jax.grad(value)(jnp.asarray(HEIGHTS)) * direction)
    difference = central_difference(value, HEIGHTS, direction)
    assert float(slope) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.thorough
def test_a_cap_has_a_finite_slope_beyond_its_rim():
    cap = SphericalCap(2.0)
    height = lambda x: cap.points(jnp.array([x, 0.0]))[2]
    rim = 2 * 0.98**0.5
    assert float(height(rim - 1e-9)) == pytest.approx(float(height(rim + 1e-9)), abs=1e-7)
    slope = jax.grad(height)
    assert float(slope(rim - 1e-9)) == pytest.approx(float(slope(rim + 1e-9)), rel=1e-6)
    assert np.isfinite(slope(3.0))


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: HeightMap(np.full((5, 5), np.nan), 1.0), ValueError, "unknown"),
        (lambda: HeightMap(np.full((5, 5), np.nan), 1.0, unknown=0.0), ValueError, "valid"),
        (lambda: HeightMap(np.full((5, 5), np.inf), 1.0, unknown=0.0), ValueError, "finite"),
        (lambda: HeightMap(np.eye(5, dtype=int), 1.0), ValueError, "smoothing"),
        (lambda: HeightMap(np.eye(5), 1.0, smoothing=0.9), ValueError, "smoothing"),
        (lambda: HeightMap(np.ones((3, 5)), 1.0), ValueError, "4 x 4"),
        (lambda: HeightMap(np.ones(5), 1.0), ValueError, "4 x 4"),
        (lambda: HeightMap(np.ones((5, 5), bool), 1.0), TypeError, "real numbers"),
        (lambda: HeightMap(np.ones((5, 5)), 0.0), ValueError, "pixel_size"),
        (lambda: HeightMap(np.ones((5, 5)), 1.0, smoothing=-1.0), ValueError, "smoothing"),
        (lambda: Cylinder(0.0), ValueError, "radius"),
        (lambda: SphericalCap(-1.0), ValueError, "radius"),
    ],
)
def test_wrong_arguments_raise_errors_with_their_name(make, error, text):
    with pytest.raises(error, match=text):
        make()


def test_a_graph_needs_a_function(without_type_checks):
    function: object = 3.0
    with pytest.raises(TypeError, match="function"):
        Graph(function)  # pyright: ignore[reportArgumentType]


def test_traced_heights_have_no_unknown_pixels():
    with pytest.raises(ValueError, match="unknown"):
        jax.jit(lambda h: HeightMap(h, 1.0, unknown=0.0).coefficients)(HEIGHTS)
