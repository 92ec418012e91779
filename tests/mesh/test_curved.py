"""Lengths and areas of tissues on surfaces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, random_like, random_tissue

import vertax as vx
from vertax.surfaces import Cylinder, Graph, HeightMap, SphericalCap
from vertax.transitions._edge_frames import EdgeFrames

SIDE = 4.0
N_CELLS = 16


def bump(height, period=SIDE):
    wave = 2 * np.pi / period
    return Graph(
        jax.tree_util.Partial(
            lambda h, x: h * jnp.cos(wave * x[0]) * jnp.cos(wave * x[1]), jnp.asarray(height)
        )
    )


@pytest.fixture(scope="module")
def flat():
    return random_tissue(N_CELLS, 2, lloyd_steps=2)


def free_cluster(n, centre=(0.0, 0.0)):
    cluster = vx.initialise.free_voronoi(n, key=1, lloyd_steps=2)
    vertices = cluster.vertices - jnp.mean(cluster.vertices, axis=0) + jnp.asarray(centre)
    return vx.Tissue(vertices, cluster.topology, cluster.boundary)


def integrated_areas(tissue, nodes=12):
    """Areas by Gauss-Legendre integration over the triangles about the centroids."""
    m = tissue.topology
    corners, cell = np.asarray(tissue.corners), np.asarray(m.cell)
    inside = cell < tissue.n_cells
    p, q = corners[inside], corners[np.asarray(m.next)][inside]
    centre = np.asarray(tissue.centroids)[cell[inside]]
    x, w = np.polynomial.legendre.leggauss(nodes)
    u, v = (each.ravel()[:, None] for each in np.meshgrid((x + 1) / 2, (x + 1) / 2, indexing="ij"))
    weight = (np.outer(w, w) / 4).ravel() * u[:, 0]
    a, b = (p - centre)[:, None], (q - centre)[:, None]
    places = jnp.asarray(centre[:, None] + u * ((1 - v) * a + v * b))
    density = np.asarray(tissue.surface.density(places))
    double = a[:, 0, 0] * b[:, 0, 1] - a[:, 0, 1] * b[:, 0, 0]
    return np.bincount(cell[inside], double * (density @ weight), tissue.n_cells)


def relative_rms(areas, exact):
    return float(np.sqrt(np.mean((np.asarray(areas) / exact - 1) ** 2)))


@pytest.mark.parametrize(("height", "error"), [(0.25, 1e-3), (0.75, 6e-3)])
def test_areas_agree_with_a_fine_integration(flat, height, error):
    tissue = flat.with_surface(bump(height))
    exact = integrated_areas(tissue)
    assert relative_rms(tissue.areas, exact) < error
    assert float(jnp.sum(tissue.areas)) == pytest.approx(exact.sum(), rel=error / 10)


@pytest.mark.thorough
def test_areas_on_a_cap_converge_to_those_of_the_sphere():
    # The same cluster with cells of half the size has a quarter of the curvature: the error falls by 2⁴.
    cluster, errors = free_cluster(20), []
    for radius in (8.0, 16.0, 32.0):
        tissue = cluster.with_surface(SphericalCap(radius))
        errors.append(relative_rms(tissue.areas, integrated_areas(tissue)))
    assert np.all(np.diff(np.log2(errors)) < -3.7)


@pytest.mark.thorough
def test_a_round_cluster_on_a_cap_has_the_area_of_the_cap():
    # The whole cap up to the polar angle θ has the area 2 π R² (1 - cos θ).
    cluster = free_cluster(120)
    tissue = cluster.with_surface(SphericalCap(12.0))
    flat_area = jnp.sum(cluster.areas)
    radius = jnp.sqrt(flat_area / jnp.pi)
    exact = 2 * jnp.pi * 12 * (12 - jnp.sqrt(144 - radius**2))
    # (The cluster is not exactly a disc.)
    assert float(jnp.sum(tissue.areas)) == pytest.approx(float(exact), rel=3e-3)


def test_lengths_on_a_cylinder_are_chords_with_an_error_of_second_order(flat):
    errors = []
    for turns in (1, 2, 4):
        radius = SIDE * turns / (2 * np.pi)
        box = vx.Periodic(jnp.diag(jnp.array([turns * SIDE, SIDE])))
        stretched = flat.vertices * jnp.array([float(turns), 1.0])
        plane = vx.Tissue(stretched, flat.topology, box, 0.0)
        tube = plane.with_surface(Cylinder(radius))
        np.testing.assert_allclose(tube.areas, plane.areas, rtol=1e-12)
        # The exact chord: 2 R sin(Δu / 2 R) around, Δv along.
        azimuthal, axial = np.asarray(plane.edge_vectors).T
        chord = np.hypot(2 * radius * np.sin(azimuthal / (2 * radius)), axial)
        np.testing.assert_allclose(tube.edge_lengths, chord, rtol=1e-12)
        narrow = vx.Tissue(flat.vertices, flat.topology, flat.boundary, 0.0)
        lengths = eqx.tree_at(
            lambda t: t.surface, narrow, Cylinder(radius), is_leaf=lambda x: x is None
        ).edge_lengths
        errors.append(float(jnp.max(1 - lengths / narrow.edge_lengths)))
    assert np.all(np.abs(np.diff(np.log2(errors)) + 2) < 0.1)


def test_a_tilted_plane_is_isometric_to_the_plane(flat):
    slope = jnp.array([0.75, 0.0])
    shrink = jnp.array([0.8, 1.0])
    box = vx.Periodic(flat.boundary.lattice * shrink)
    tilted = vx.Tissue(
        flat.vertices * shrink,
        flat.topology,
        box,
        flat.softening,
        surface=Graph(lambda x: jnp.dot(slope, x)),
    )
    for name in ("areas", "perimeters", "edge_lengths", "shape_factors"):
        np.testing.assert_allclose(getattr(tilted, name), getattr(flat, name), rtol=1e-12)


@pytest.mark.parametrize("surface", [bump(0.5), Cylinder(SIDE / (2 * np.pi))], ids=str)
def test_measurements_do_not_depend_on_the_image_of_the_box(flat, surface):
    tissue = flat.with_surface(surface)
    steps = jnp.asarray(np.random.default_rng(1).integers(-2, 3, (flat.n_vertices, 2)))
    frames = flat.topology.frame - jnp.repeat(steps, 3, axis=0)
    moved = eqx.tree_at(lambda t: t.topology.frame, tissue, frames.astype(jnp.int32))
    moved = moved.with_vertices(tissue.vertices + flat.boundary.translation(steps))
    np.testing.assert_allclose(moved.areas, tissue.areas, rtol=1e-11)
    np.testing.assert_allclose(moved.edge_lengths, tissue.edge_lengths, rtol=1e-11)


@pytest.mark.thorough
def test_areas_are_continuous_in_a_transition(flat):
    tissue = flat.with_surface(bump(0.75))
    frames = EdgeFrames(tissue)
    for edge in range(0, tissue.n_edges, 7):
        which = jnp.arange(tissue.n_edges) == edge
        length = jnp.full(tissue.n_edges, 1e-9)
        before = frames.place(tissue, which, frames.along, length)
        after = frames.flip(frames.place(tissue, which, frames.across, length), which)
        np.testing.assert_allclose(after.areas, before.areas, atol=1e-8)


@pytest.mark.parametrize(
    "surface",
    [bump(0.5), HeightMap(0.3 * np.eye(8) + 0.3 * np.eye(8)[::-1], 0.5, periodic=True)],
    ids=["graph", "map"],
)
def test_derivatives_by_vertices_and_surface_agree_with_differences(flat, surface):
    tissue = flat.with_surface(surface)

    @eqx.filter_jit
    def value(parts):
        vertices, surface = parts
        moved = eqx.tree_at(lambda t: (t.vertices, t.surface), tissue, (vertices, surface))
        weights = jnp.cos(jnp.arange(tissue.n_cells))
        return jnp.sum(moved.areas**2 * weights + moved.perimeters * weights**2)

    parts = (tissue.vertices, surface)
    direction = random_like(parts)
    slope = jax.tree.map(jnp.vdot, eqx.filter_jit(jax.grad(value))(parts), direction)
    difference = central_difference(value, parts, direction, 1e-6)
    assert float(sum(jax.tree.leaves(slope))) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.thorough
def test_spare_slots_change_nothing_and_keep_the_surface(flat):
    tissue = flat.with_surface(bump(0.5))
    roomy = tissue.with_capacity(20)
    np.testing.assert_allclose(roomy.areas[:N_CELLS], tissue.areas, rtol=1e-13)
    np.testing.assert_array_equal(roomy.areas[N_CELLS:], 0)
    assert eqx.tree_equal(roomy.without_spare().surface, tissue.surface)
    assert eqx.tree_equal(vx.mesh.pad(tissue).surface, tissue.surface)
    gradient = jax.grad(lambda y: jnp.sum(roomy.with_vertices(y).perimeters ** 2))(roomy.vertices)
    assert np.isfinite(gradient).all()


def test_a_batch_of_surfaces_maps_over_their_parameters(flat):
    heights = jnp.array([0.0, 0.3, 0.6])
    areas = jax.vmap(lambda h: jnp.sum(flat.with_surface(bump(h)).areas))(heights)
    assert float(areas[0]) == pytest.approx(SIDE**2)
    assert np.all(np.diff(areas) > 0)


def test_float32_tissues_stay_in_float32(flat):
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, flat
    )
    tissue = single.with_surface(bump(0.5))
    assert tissue.areas.dtype == tissue.edge_lengths.dtype == jnp.float32
    np.testing.assert_allclose(tissue.areas, flat.with_surface(bump(0.5)).areas, rtol=1e-5)


def test_a_tissue_that_cannot_lie_on_a_surface_is_rejected(flat):
    with pytest.raises(ValueError, match="period of the box"):
        flat.with_surface(bump(0.5, period=SIDE + 0.1))
    with pytest.raises(ValueError, match="2πR"):
        flat.with_surface(Cylinder(1.0))
    with pytest.raises(ValueError, match="finite"):
        flat.with_surface(Graph(lambda x: jnp.log(x[0] - 100)))
    with pytest.raises(ValueError, match="larger radius"):
        free_cluster(20).with_surface(SphericalCap(2.0))
    with pytest.raises(ValueError, match="arcs"):
        vx.initialise.free_voronoi(8, key=1).with_surface(SphericalCap(9.0))
    with pytest.raises(ValueError, match="surface"):
        flat.with_surface(bump(0.5)).carried(flat.boundary)


def test_a_surface_must_be_a_surface(flat, without_type_checks):
    with pytest.raises(TypeError, match="surface"):
        flat.with_surface(3.0)
