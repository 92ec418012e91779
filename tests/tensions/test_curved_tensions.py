"""Tensions, areas and loads of tissues on curved surfaces."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from curved_helpers import check_published_areas, foam_at_rest

import vertax as vx
from vertax.inference import label_image, labels_on_sphere
from vertax.surfaces import HeightMap, SphericalCap
from vertax.tensions import infer_tensions

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="the data beside the repository, ../shared/data, are not there"
)


PIXELS, RADIUS = 600, 330.0


def by_labels(tissue, labels, values):
    """Values of edges by the labels on both sides."""
    pairs = np.sort(np.append(labels, 0)[np.asarray(tissue.topology.edge_cells)], axis=1)
    return dict(zip(map(tuple, pairs.tolist()), np.asarray(values).tolist(), strict=True))


def curved(result):
    """The geometry in space."""
    assert result.curved is not None
    return result.curved


def hexagons(pixels, size):
    """Labels of a round cluster of hexagons, a foam of equal tensions."""
    row, column = np.indices((pixels, pixels)) + 0.5 - pixels / 2
    k, m = np.mgrid[-6:7, -6:7].reshape(2, -1)
    x, y = size * (k + 0.5 * m), size * 3**0.5 / 2 * m
    nearest = np.argmin((column[..., None] - x) ** 2 + (row[..., None] - y) ** 2, axis=-1)
    inside = np.hypot(x, y) < 0.4 * pixels
    return np.where(inside[nearest], nearest + 1, 0)


@pytest.fixture(scope="module")
def plane():
    return hexagons(PIXELS, 90.0)


@pytest.fixture(scope="module")
def on_sphere(plane):
    """Labels and heights of the foam on a sphere, with slopes up to about 1."""
    return labels_on_sphere(plane, RADIUS)


@pytest.fixture(scope="module")
def lifted(on_sphere):
    mask, heights = on_sphere
    return infer_tensions(mask, height=heights, pixel_size=0.5, plane_distance=0.5)


@pytest.mark.thorough
def test_equal_tensions_on_a_sphere_are_equal(on_sphere, lifted):
    assert 0.7 < curved(lifted).slopes.max() < 1.5
    spread = lambda result: np.std(result.tensions[result.determined])
    assert lifted.determined.sum() > 40
    assert spread(lifted) < 0.05
    assert spread(infer_tensions(on_sphere[0])) > 2 * spread(lifted)


def test_areas_and_perimeters_on_a_sphere(on_sphere, lifted):
    mask, _ = on_sphere
    row, column = np.indices(mask.shape) + 0.5 - PIXELS / 2
    density = RADIUS / np.sqrt(np.maximum(RADIUS**2 - row**2 - column**2, 1))
    exact = 0.25 * np.bincount(mask.ravel(), np.where(mask > 0, density, 0).ravel())
    np.testing.assert_allclose(curved(lifted).areas, exact[lifted.labels], rtol=0.02)
    # No cell is rounder than a disc, and tensions pull down on the convex side.
    assert np.all(curved(lifted).perimeters > 0.95 * 2 * np.sqrt(np.pi * curved(lifted).areas))
    assert np.nanmax(curved(lifted).normal_loads) < 0


def test_slopes_are_those_in_the_middle_of_a_cell(lifted):
    away = np.asarray(lifted.tissue.centroids) / 0.5 - PIXELS / 2
    distance = np.linalg.norm(away, axis=1)
    expected = distance / np.sqrt(RADIUS**2 - distance**2)
    np.testing.assert_allclose(curved(lifted).slopes, expected, atol=0.08)


def test_normal_loads_are_those_of_a_membrane(lifted):
    """A membrane of the tension σ on a sphere of the radius R presses with 2 σ / R per area."""
    table = lifted.cell_table()
    inner = np.isfinite(table["normal_load"]) & ~table["on_outline"]
    inner &= np.isfinite(lifted.stresses[:, 0, 0])
    # (The stress of tensions alone, without the pressures of the cells.)
    tension = np.trace(lifted.stresses[inner], axis1=1, axis2=2) / 2 + lifted.pressures[inner]
    expected = -2 * tension / (0.5 * RADIUS) * table["area_in_space"][inner]
    assert inner.sum() > 5
    assert table["normal_load"][inner].sum() / expected.sum() == pytest.approx(1, abs=0.05)


@pytest.mark.thorough
def test_a_flat_height_map_changes_nothing(plane):
    plain = infer_tensions(plane, pixel_size=1.0)
    flat = infer_tensions(plane, pixel_size=1.0, height=np.full(plane.shape, 3.0))
    np.testing.assert_allclose(flat.tensions, plain.tensions, atol=1e-6)
    np.testing.assert_allclose(flat.tension_deviations, plain.tension_deviations, rtol=1e-4)
    np.testing.assert_allclose(flat.stresses, plain.stresses, atol=1e-6)
    np.testing.assert_allclose(curved(flat).areas, plain.tissue.areas, rtol=1e-6)
    assert np.nanmax(np.abs(curved(flat).normal_loads)) < 1e-6


@pytest.mark.thorough
def test_a_tilted_plane_is_the_plane(plane):
    """The image of a plane of slope 1 is compressed to 0.71 along one direction."""
    n = int(PIXELS / 2**0.5)
    tilted = plane[np.floor((np.arange(n) + 0.5) * 2**0.5).astype(int)]
    heights = np.broadcast_to(np.arange(float(n))[:, None], tilted.shape)
    result = infer_tensions(tilted, height=heights)
    assert np.std(result.tensions[result.determined]) < 0.03
    np.testing.assert_allclose(curved(result).slopes, 1, atol=0.02)


@pytest.mark.thorough
def test_tensions_on_a_sphere_are_as_accurate_as_in_the_plane():
    start = vx.initialise.free_voronoi(19, key=jax.random.key(3))
    foam, tensions = foam_at_rest(start)
    plane = label_image(foam, 900)
    true = by_labels(foam, np.arange(1, 20), tensions)

    def errors(result):
        inferred = by_labels(result.tissue, result.labels, result.tensions)
        deviations = by_labels(result.tissue, result.labels, result.tension_deviations)
        pairs = [pair for pair, value in inferred.items() if np.isfinite(value) and pair in true]
        mean = np.mean([true[pair] for pair in pairs])
        error = np.array([inferred[pair] - true[pair] / mean for pair in pairs])
        return np.sqrt(np.mean(error**2)), error / [deviations[pair] for pair in pairs]

    mask, heights = labels_on_sphere(plane, 500.0)
    lifted, scores = errors(infer_tensions(mask, height=heights))
    planar, _ = errors(infer_tensions(plane))
    projected, _ = errors(infer_tensions(mask))
    assert lifted < 1.5 * planar + 0.01
    assert projected > 3 * lifted
    assert np.mean(np.abs(scores) < 1.96) > 0.85


@pytest.mark.thorough
def test_tensions_of_a_tissue_on_a_surface_use_its_surface():
    tissue = vx.initialise.free_voronoi(20, key=0)
    planar = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary)
    on_cap = planar.with_surface(SphericalCap(5.0))
    result = infer_tensions(on_cap, edges="straight")
    np.testing.assert_allclose(curved(result).areas, on_cap.areas, rtol=1e-3)
    np.testing.assert_allclose(curved(result).lengths, on_cap.edge_lengths, rtol=1e-3)
    same = infer_tensions(planar, edges="straight", height=SphericalCap(5.0))
    np.testing.assert_allclose(same.tensions, result.tensions, atol=1e-9)
    other = infer_tensions(planar, edges="straight")
    assert np.nanmax(np.abs(other.tensions - same.tensions)) > 1e-3


@needs_data
@pytest.mark.thorough
def test_areas_of_a_real_epithelium_are_the_published_ones():
    folder = DATA / "curved"
    options = {"height": folder / "heights.tif", "unknown_height": 0, "pixel_size": 0.183}
    result = infer_tensions(folder / "outlines.tif", **options)
    check_published_areas(result.tissue.centroids, curved(result).areas)


@pytest.mark.parametrize(
    ("height", "error", "message"),
    [
        (np.ones((4, 5)), ValueError, r"`height` must have shape \(60, 60\)"),
        (np.full((60, 60), np.nan), ValueError, "must have valid pixels"),
        (np.full((60, 60), np.inf), ValueError, "must be finite"),
        (np.full((60, 60), "a"), TypeError, "must hold real numbers"),
    ],
)
def test_heights_that_do_not_fit_are_rejected(height, error, message):
    corner = np.indices((60, 60))
    mask = 1 + (corner[0] > 30) + (corner[0] > 30) * (corner[1] > 25)
    with pytest.raises(error, match=message):
        infer_tensions(mask, height=height)


@pytest.mark.parametrize("name", ["heights.npy", "heights.png"])
def test_a_file_that_holds_no_heights_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"no numbers")
    corner = np.indices((60, 60))
    mask = 1 + (corner[0] > 30) + (corner[0] > 30) * (corner[1] > 25)
    with pytest.raises(ValueError, match="Argument `height` must name"):
        infer_tensions(mask, height=tmp_path / name)


def test_an_image_of_heights_needs_pixels():
    tissue = vx.initialise.free_voronoi(12, key=0)
    with pytest.raises(TypeError, match="must be a surface for a source without pixels"):
        infer_tensions(tissue, edges="straight", height=np.ones((60, 60)))


def test_labels_on_a_large_sphere_are_those_of_the_plane():
    labels = np.arange(1, 101).reshape(10, 10)
    mask, heights = labels_on_sphere(labels, 1e6)
    np.testing.assert_array_equal(mask, labels)
    assert np.ptp(heights) < 1e-4
    with pytest.raises(ValueError, match="`radius` must be positive"):
        labels_on_sphere(labels, 0.0)


@pytest.mark.thorough
def test_a_height_map_is_a_surface_of_a_mask():
    corner = np.indices((60, 60))
    mask = 1 + (corner[0] > 30) + (corner[0] > 30) * (corner[1] > 25)
    surface = HeightMap(jnp.zeros((60, 60)), 1.0)
    result = infer_tensions(mask, height=surface, pixel_size=1.0)
    np.testing.assert_allclose(curved(result).areas, result.tissue.areas, rtol=1e-3)
