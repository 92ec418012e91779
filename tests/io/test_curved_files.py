"""Files and pictures of tissues on surfaces."""

from itertools import product

import equinox as eqx
import jax
import meshio
import numpy as np
import pytest
from helpers import random_tissue
from mpl_toolkits.mplot3d.proj3d import proj_transform

import vertax as vx
from vertax.surfaces import Cylinder, Graph, HeightMap, SphericalCap

SIDE, N_CELLS = 3.0, 9
HEIGHTS = np.random.default_rng(0).normal(size=(6, 6))


@pytest.fixture(scope="module")
def flat():
    return random_tissue(N_CELLS, 1)


@pytest.fixture
def tube(flat):
    return flat.with_surface(Cylinder(SIDE / (2 * np.pi)))


def on_cap():
    cluster = vx.initialise.free_voronoi(N_CELLS, key=1)
    surface = SphericalCap(np.float32(9.0))
    return vx.Tissue(cluster.vertices, cluster.topology, cluster.boundary, surface=surface)


@pytest.mark.parametrize(
    "make",
    [
        lambda flat: flat.with_surface(Cylinder(SIDE / (2 * np.pi))),
        lambda flat: flat.with_surface(HeightMap(HEIGHTS, SIDE / 6, periodic=True)),
        lambda flat: on_cap(),
    ],
    ids=["tube", "map", "cap"],
)
def test_surfaces_are_loaded_as_they_were_saved(flat, make, tmp_path):
    tissue = make(flat)
    vx.save(tmp_path / "tissue.npz", tissue)
    assert eqx.tree_equal(vx.load(tmp_path / "tissue.npz", vx.Tissue), tissue)
    trajectory = vx.mesh.Trajectory()
    for _ in range(2):
        trajectory.append(tissue, time=0.0)
    vx.save(tmp_path / "run.npz", trajectory)
    for frame in vx.load(tmp_path / "run.npz", vx.mesh.Trajectory):
        assert eqx.tree_equal(frame, tissue)


def test_a_trajectory_may_have_several_surfaces(flat, tmp_path):
    trajectory = vx.mesh.Trajectory()
    for height in (1.0, 2.0):
        trajectory.append(flat.with_surface(HeightMap(height * HEIGHTS, SIDE / 6, periodic=True)))
    vx.save(tmp_path / "run.npz", trajectory)
    for loaded, frame in zip(
        vx.load(tmp_path / "run.npz", vx.mesh.Trajectory), trajectory, strict=True
    ):
        assert eqx.tree_equal(loaded, frame)


def test_problems_keep_the_surface_of_their_tissue(tube, tmp_path):
    energy = vx.energies.ShapeFactorEnergy(3.7)
    problem = vx.InverseProblem(tube, energy, vx.costs.MeanShapeFactor(3.8))
    vx.save(tmp_path / "problem.npz", problem)
    loaded = vx.load(tmp_path / "problem.npz", vx.InverseProblem)
    assert eqx.tree_equal(loaded.tissue.surface, tube.surface)


def test_a_function_has_no_place_in_a_file(flat, tmp_path):
    with pytest.raises(ValueError, match=r"`surface\.function` is of type"):
        vx.save(tmp_path / "tissue.npz", flat.with_surface(Graph(lambda x: 0 * x[0])))


def test_a_broken_surface_is_rejected(tube, tmp_path):
    vx.save(tmp_path / "tissue.npz", tube)
    arrays = dict(np.load(tmp_path / "tissue.npz"))
    for changes, message in (
        ({"data.surface.radius": np.ones(2)}, "surface"),
        ({"data.surface.radius": np.asarray(1.0)}, "period"),
    ):
        np.savez(tmp_path / "broken.npz", allow_pickle=False, **(arrays | changes))
        with pytest.raises(ValueError, match=message):
            vx.load(tmp_path / "broken.npz", vx.Tissue)


def test_vtk_files_have_the_points_in_space(tube, tmp_path):
    path = tmp_path / "tissue.vtu"
    vx.io.write_vtk(path, tube, edges={})
    for name in ("tissue.vtu", "tissue-edges.vtu"):
        points = meshio.read(tmp_path / name).points
        np.testing.assert_allclose(np.hypot(*points[:, :2].T), SIDE / (2 * np.pi), rtol=1e-9)
    corners = np.asarray(tube.surface.points(tube.corners))
    apart = points[:, None] - corners
    assert np.linalg.norm(apart, axis=-1).min(axis=1).max() < 1e-6 + SIDE


def test_stress_bars_are_drawn_in_the_chart(flat):
    tilted = flat.with_surface(Graph(lambda x: 0.75 * x[0]))
    stress = np.broadcast_to(np.diag([1.0, 1.0]), (N_CELLS, 2, 2))
    bars = vx.plotting.plot_stress(tilted, stress).collections[-1].get_segments()
    lengths = np.sort(np.linalg.norm([bar[1] - bar[0] for bar in bars], axis=-1))
    assert lengths[0] == pytest.approx(0.8 * lengths[-1])


def test_a_picture_in_space_has_one_polygon_for_each_cell(tube):
    roomy = tube.with_capacity(N_CELLS + 3)
    values = np.arange(roomy.n_cells, dtype=float)
    ax = vx.plotting.plot_surface(roomy, values, label="number")
    np.testing.assert_array_equal(ax.collections[0].get_array(), np.arange(N_CELLS))
    assert vx.plotting.plot_surface(tube, ax=ax) is ax
    assert np.unique(ax.collections[1].get_facecolor(), axis=0).shape[0] > 3


def test_a_picture_in_space_is_not_cropped(flat):
    ax = vx.plotting.plot_surface(flat.with_surface(Graph(lambda x: 0.1 * x[0])), elevation=90.0)
    corners = np.array([*product(ax.get_xlim(), ax.get_ylim(), ax.get_zlim())])
    x, y, z = corners.T
    projected = np.stack(proj_transform(x, y, z, ax.get_proj())[:2], axis=-1)
    assert ax.bbox.count_contains(ax.transData.transform(projected)) == len(corners)


def test_a_picture_in_space_needs_a_surface(flat):
    with pytest.raises(ValueError, match="plot_tissue"):
        vx.plotting.plot_surface(flat)
    with pytest.raises(ValueError, match="cells"):
        vx.plotting.plot_surface(flat.with_surface(Graph(lambda x: 0 * x[0])), np.ones(3))


def test_another_program_is_rejected(tube):
    assert jax.tree.leaves(tube.surface)
    with pytest.raises(ValueError, match="surface"):
        vx.External(vx.external.SurfaceEvolver())(tube, vx.energies.ShapeFactorEnergy(3.7))
