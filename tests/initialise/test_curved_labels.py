"""Tissues on surfaces from masks and heights."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from curved_helpers import check_published_areas

import vertax as vx
from vertax.initialise import from_labels
from vertax.surfaces import HeightMap

DATA = Path(__file__).parents[3] / "shared" / "data" / "curved"
N, CELL = 120, 20


@pytest.fixture(scope="module")
def mask():
    """Rows of bricks, every second row shifted by half a brick."""
    row, column = np.indices((N, N))
    shift = np.where(row // CELL % 2, CELL // 2, 0)
    return 1 + row // CELL * (N // CELL) + (column + shift) % N // CELL


def free(mask):
    return np.pad(np.where(np.isin(mask % (N // CELL), (0, 1)), 0, mask), CELL)


@pytest.mark.parametrize("sized", [True, False])
def test_areas_on_a_tilted_plane(mask, sized):
    """The slope is that of the image in any unit of length, and areas are larger by √(1 + slope²)."""
    labels = free(mask)
    heights = 0.75 * np.indices(labels.shape)[1]
    size = {"pixel_size": (0.4, 0.2), "plane_distance": 0.2} if sized else {}
    result = from_labels(labels, boundary="free", height=heights, **size)
    flat = result.tissue.with_surface(None)
    assert flat.arcs is None
    np.testing.assert_allclose(result.tissue.areas, 1.25 * flat.areas, rtol=1e-6)
    with_arcs = from_labels(labels, boundary="free", **size)
    np.testing.assert_allclose(flat.vertices, with_arcs.tissue.vertices, atol=1e-12)


@pytest.mark.thorough
def test_a_surface_has_the_period_of_the_mask(mask):
    wave = 3 * np.sin(2 * np.pi * (np.arange(N) + 0.5) / N) + np.zeros((N, 1))
    periodic = from_labels(mask, boundary="periodic", height=wave, pixel_size=0.1).tissue
    np.testing.assert_allclose(periodic.boundary.lattice, np.diag([12.0, 12.0]))
    assert periodic.areas.sum() > 1.001 * 144
    mirrored = from_labels(mask, boundary="mirrored", height=wave, pixel_size=0.1).tissue
    x = jnp.array([[1.5, 4.0], [24 - 1.5, 4.0], [1.5, 24 - 4.0], [25.5, 28.0]])
    assert mirrored.surface is not None
    heights = np.asarray(mirrored.surface.points(x))[:, 2]
    np.testing.assert_allclose(heights, heights[0], atol=1e-9)


def test_a_surface_is_accepted_in_place_of_heights(mask):
    surface = HeightMap(np.zeros((8, 8)), 10.0)
    result = from_labels(free(mask), boundary="free", height=surface)
    assert eqx.tree_equal(result.tissue.surface, surface)


def test_cells_with_two_sides_on_the_outline_join_a_neighbour(mask):
    """A cell with one arc has two sides; its chord has no area."""
    labels = free(mask)
    row, column = np.indices(labels.shape)
    top = np.flatnonzero(labels.any(axis=1))[0]
    middle = int(np.median(np.flatnonzero(labels[top])))
    lens = (np.hypot(row - top, column - middle) < 6) & (labels > 0)
    labels = np.where(lens, labels.max() + 1, labels)
    plain = from_labels(labels, boundary="free")
    assert plain.tissue.neighbour_counts.min() < 3 or labels.max() in plain.labels
    curved = from_labels(labels, boundary="free", height=np.zeros(labels.shape))
    assert np.asarray(curved.tissue.areas).min() > 0


def test_tensions_of_a_segmentation_on_a_surface_are_those_of_its_mask(mask):
    labels = free(mask)
    row, column = np.indices(labels.shape)
    heights = 0.1 * np.hypot(row, column) ** 1.5
    source = from_labels(labels, boundary="free", height=heights)
    result = vx.tensions.infer_tensions(source, edges="arcs")
    expected = vx.tensions.infer_tensions(labels, height=heights, edges="arcs")
    assert result.curved is not None
    assert expected.curved is not None
    np.testing.assert_allclose(result.curved.areas, expected.curved.areas, rtol=0.02)
    np.testing.assert_allclose(result.tensions, expected.tensions, atol=0.02)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"height": np.ones((4, 5))}, ValueError, r"`height` must have shape \(120, 120\)"),
        ({"height": np.full((N, N), np.nan)}, ValueError, "must have valid pixels"),
        ({"height": np.ones((N, N)), "inner_arcs": True}, ValueError, "straight chords"),
        ({"height": np.ones((N, N)), "plane_distance": 0.0}, ValueError, "`plane_distance`"),
    ],
)
def test_heights_that_do_not_fit_are_rejected(mask, options, error, message):
    with pytest.raises(error, match=message):
        from_labels(mask, boundary="periodic", **options)


@pytest.mark.thorough
def test_a_micrograph_with_heights_is_a_tissue_on_a_surface():
    tissue = vx.initialise.periodic_voronoi(16, key=1, lloyd_steps=2)
    image = vx.inference.Microscope(pixels=96, psf_width=1.5)(tissue, key=jax.random.key(0))
    heights = 0.5 * np.indices(image.shape)[0]
    options = {"boundary": "free", "height": heights}
    curved = vx.initialise.from_microscopy(np.asarray(image), **options).tissue
    flat = curved.with_surface(None)
    np.testing.assert_allclose(curved.areas, 1.25**0.5 * flat.areas, rtol=1e-6)


@pytest.mark.skipif(not DATA.exists(), reason="the folder ../shared/data/curved is not there")
@pytest.mark.thorough
def test_areas_of_a_real_epithelium_are_the_published_ones():
    """A polygon has another projected area than its cell in the image; their ratio is taken out."""
    labels = vx.tensions.read_mask(DATA / "outlines.tif")
    heights = vx.io.read_image(DATA / "heights.tif")
    options = {"boundary": "free", "pixel_size": 0.183}
    result = from_labels(labels, height=heights, unknown_height=0, **options)
    curved, image = result.tissue, from_labels(labels, inner_arcs=True, **options)
    factors = np.asarray(curved.areas / curved.with_surface(None).areas)
    areas = np.asarray(image.tissue.areas)[np.isin(image.labels, result.labels)] * factors
    check_published_areas(curved.centroids, areas)
