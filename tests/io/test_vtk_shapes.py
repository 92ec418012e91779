"""Cells that are not convex, in VTK files."""

import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue

import vertax as vx
from vertax.io._read_vtk import _outline
from vertax.io._triangles import is_convex, triangulate
from vertax.plotting import cell_polygons


def area(corners):
    x, y = np.moveaxis(corners, -1, 0)
    return 0.5 * np.sum(x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1), axis=-1)


def spiral(turns, width):
    """A simple polygon that winds around itself."""
    angle = np.linspace(0, 2 * np.pi * turns, 60)
    outer = (1 + angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = (1 + angle - width)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([outer, inner[::-1]])


SHAPES = {
    "dart": np.array([[0, 0], [2, 1], [0, 2], [1, 1.0]]),
    "comb": np.array([[0, 0], [5, 0], [5, 3], [4, 1], [3, 3], [2, 1], [1, 3], [0.5, 1], [0, 3.0]]),
    "spiral": spiral(2, 0.8),
    "points in one line": np.array(
        [[0, 0], [1, 0], [2, 0], [2, 2], [1, 2], [1, 1], [0, 1], [0, 0.5]]
    ),
    "points in one place": np.array([[0, 0], [0, 0], [2, 1], [2, 1], [0, 2], [1, 1], [1, 1.0]]),
    "points close together": np.array([[0, 0], [2, 1], [0, 2], [1, 1], [1, 1 - 1e-13]]),
    "a far corner": 1e6 + np.array([[0, 0], [2, 1], [0, 2], [1, 1.0]]),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("first", [0, 1, 3])
def test_triangles_tile_a_polygon(shape, first):
    polygon = np.roll(shape, first, axis=0)
    assert not is_convex(polygon)
    numbers = triangulate(polygon)
    # Areas that add up to that of the polygon, none negative: no two overlap.
    assert (area(polygon[numbers]) >= 0).all()
    np.testing.assert_allclose(area(polygon[numbers]).sum(), area(polygon), rtol=1e-9)
    assert len(numbers) == len(polygon) - 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_outline_of_the_triangles_is_the_polygon(dtype):
    # In float32 points on a line are beside it, by rounding.
    for corners in ([[0, 0], [2, 1.1], [0.1, 2.3], [0.9, 1.2]], [[0, 0], [3, 1], [0.3, 2.7]]):
        ends = np.roll(corners, -1, axis=0)
        along = np.linspace(0, 1, 20, endpoint=False)[:, None]
        polygon = np.concatenate([a + along * (b - a) for a, b in zip(corners, ends, strict=True)])
        ring = _outline([*triangulate(polygon.astype(dtype))])
        np.testing.assert_array_equal(np.roll(ring, -np.argmin(ring)), np.arange(len(polygon)))


def test_convex_polygons_are_found():
    angle = np.linspace(0, 2 * np.pi, 7)[:-1]
    hexagon = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert is_convex(hexagon)
    assert is_convex(np.repeat(hexagon, 2, axis=0))
    assert not is_convex(hexagon[::-1])


def bent(boundary):
    """A tissue with cells that are far from convex."""
    if boundary == "periodic":
        tissue = random_tissue(9)
        shift = 0.12 * np.random.default_rng(0).normal(size=tissue.vertices.shape)
        return tissue.with_vertices(tissue.vertices + jnp.asarray(shift))
    tissue = cluster(9, inner_arcs=True)
    angles = 0.9 * np.random.default_rng(0).choice([-1, 1], tissue.n_edges)
    return tissue.with_angles(jnp.asarray(angles))


@pytest.mark.parametrize("boundary", ["periodic", "free"])
@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_every_element_is_convex_and_they_have_the_area_of_their_cell(tmp_path, boundary, suffix):
    meshio = pytest.importorskip("meshio")
    tissue = bent(boundary)
    polygons, counts = cell_polygons(tissue, 16)
    polygons = [polygon[:n] for polygon, n in zip(polygons, counts, strict=True)]
    assert sum(not is_convex(polygon) for polygon in polygons) > 3
    vx.io.write_vtk(
        tmp_path / f"a.{suffix}", tissue, cells={"twice": 2 * np.arange(9)}, points_per_arc=16
    )
    mesh = meshio.read(tmp_path / f"a.{suffix}")
    rings = [mesh.points[ring][:, :2] for block in mesh.cells for ring in block.data]
    assert all(is_convex(ring) for ring in rings)
    cell = np.concatenate(mesh.cell_data["cell"])
    np.testing.assert_array_equal(np.concatenate(mesh.cell_data["twice"]), 2 * cell)
    covered = np.bincount(cell, [area(ring) for ring in rings])
    np.testing.assert_allclose(covered, [area(polygon) for polygon in polygons], rtol=1e-6)


@pytest.mark.parametrize("boundary", ["periodic", "free"])
def test_pyvista_measures_and_draws_the_areas(tmp_path, boundary):
    pyvista = pytest.importorskip("pyvista", exc_type=ImportError)
    tissue = bent(boundary)
    vx.io.write_vtk(tmp_path / "a.vtu", tissue, points_per_arc=64)
    mesh = pyvista.read(tmp_path / "a.vtu")
    # VTK integrates over a polygon as a fan about its first corner, also in versions that draw it correctly.
    sizes = mesh.compute_cell_sizes(length=False, volume=False)["Area"]
    measured = np.bincount(mesh.cell_data["cell"], sizes)
    np.testing.assert_allclose(measured, tissue.areas, rtol=1e-3)
    pixels = 800
    low, high = mesh.points.min(axis=0)[:2], mesh.points.max(axis=0)[:2]
    for cell in range(tissue.n_cells):
        plotter = pyvista.Plotter(off_screen=True, window_size=(pixels, pixels))
        plotter.background_color = "black"
        part = mesh.extract_cells(np.flatnonzero(mesh.cell_data["cell"] == cell))
        plotter.add_mesh(part, color="white", lighting=False)
        plotter.enable_parallel_projection()
        plotter.view_xy()
        plotter.camera.focal_point = (*(0.5 * (low + high)), 0.0)
        plotter.camera.position = (*(0.5 * (low + high)), 10.0)
        plotter.camera.parallel_scale = 0.5 * np.max(high - low)
        picture = plotter.screenshot(return_img=True)
        plotter.close()
        drawn = np.mean(picture[..., 0] > 127) * np.max(high - low) ** 2
        assert drawn == pytest.approx(float(tissue.areas[cell]), rel=0.02)
