"""Free tissues: exterior, arcs and geometry."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import (
    angles_of,
    cluster,
    doublet,
    forces,
    outline_length,
    relabelled,
    rotated,
    with_angles,
)
from helpers import central_difference, random_like, random_tissue
from hypothesis import example, given, settings, strategies as st

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity, ShapeFactorEnergy

few = settings(max_examples=10, deadline=None)
clusters = st.builds(  # functions that create a tissue
    lambda n, seed, curved: lambda: cluster(n, seed, random_angles=True, inner_arcs=curved),
    st.sampled_from([2, 9]),
    st.integers(0, 2**16),
    st.booleans(),
)


PER_CELL = ("areas", "perimeters", "shape_factors", "centroids")
PER_EDGE = ("edge_lengths", "edge_curvatures")


@eqx.filter_jit
def compiled_geometry(tissue):
    return {name: getattr(tissue, name) for name in (*PER_CELL, *PER_EDGE)}


def geometry(tissue):
    return {name: np.asarray(value) for name, value in compiled_geometry(tissue).items()}


@few
@given(clusters, st.floats(0, 6.3), st.floats(-30, 30))
@pytest.mark.thorough
def test_geometry_is_invariant_under_rigid_motions(recipe, angle, x):
    tissue = recipe()
    before, after = geometry(tissue), geometry(rotated(tissue, angle, (x, -0.3 * x)))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    expected = before.pop("centroids") @ turn + [x, -0.3 * x]
    np.testing.assert_allclose(after.pop("centroids"), expected, atol=1e-8)
    for name, values in before.items():
        np.testing.assert_allclose(after[name], values, rtol=1e-9, atol=1e-9)


@few
@given(clusters, st.integers(0, 1000))
def test_geometry_is_invariant_under_relabelling(recipe, seed):
    tissue = recipe()
    new, cell, edge = relabelled(tissue, seed)
    before, after = geometry(tissue), geometry(new)
    for name in PER_CELL:
        # Not exactly: the order of sums differs, and small areas are differences of large numbers.
        np.testing.assert_allclose(after[name][cell], before[name], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(after["edge_lengths"][edge], before["edge_lengths"], rtol=1e-12)


@few
@given(clusters, st.floats(0.01, 100))
def test_geometry_scales_with_the_unit_of_length(recipe, unit):
    tissue = recipe()
    vertices = jnp.asarray(unit * np.asarray(tissue.vertices))
    scaled = vx.Tissue(
        vertices, tissue.topology, vx.Free(), angles=tissue.angles, inner_arcs=tissue.inner_arcs
    )
    before, after = geometry(tissue), geometry(scaled)
    np.testing.assert_allclose(
        after["areas"], unit**2 * before["areas"], rtol=1e-9, atol=1e-9 * unit**2
    )
    np.testing.assert_allclose(after["edge_lengths"], unit * before["edge_lengths"], rtol=1e-9)
    assert scaled.angle_length == pytest.approx(float(unit * tissue.angle_length))


@pytest.mark.parametrize("inner_arcs", [False, True])
def test_geometry_agrees_with_fine_polygons(inner_arcs):
    tissue = cluster(12, 3, random_angles=True, inner_arcs=inner_arcs, softening=0.0)
    m = tissue.topology
    n = 2000
    points = np.asarray(tissue.edge_points(jnp.linspace(0, 1, n + 1)))
    points = points[np.asarray(m.edge)]
    points = np.where(np.asarray(m.forward)[:, None, None], points, points[:, ::-1])
    p, q = points[:, :-1], points[:, 1:]
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    sums = lambda x: np.bincount(np.asarray(m.cell), x)[: tissue.n_cells]
    areas = sums(cross.sum(1) / 2)
    np.testing.assert_allclose(tissue.areas, areas, rtol=1e-5)
    lengths = np.linalg.norm(q - p, axis=-1).sum(1)
    np.testing.assert_allclose(tissue.perimeters, sums(lengths), rtol=1e-6)
    moment = ((p + q) * cross[..., None] / 6).sum(1)
    centroids = np.stack([sums(moment[:, k]) / areas for k in (0, 1)], axis=1)
    np.testing.assert_allclose(tissue.centroids, centroids, atol=1e-5)
    # Tangents, and the radius from three points.
    start, end = tissue.edge_tangents
    forward = points[np.asarray(m.half_edge)]
    step = lambda d: d / np.linalg.norm(d, axis=1, keepdims=True)
    np.testing.assert_allclose(start, step(forward[:, 1] - forward[:, 0]), atol=2e-3)
    np.testing.assert_allclose(end, step(forward[:, -1] - forward[:, -2]), atol=2e-3)
    length = np.asarray(tissue.edge_lengths)
    turn = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    angle = np.asarray(tissue.edge_angles)
    np.testing.assert_allclose(turn, np.sin(2 * angle), atol=1e-12)
    np.testing.assert_allclose(tissue.edge_curvatures * length, 2 * angle, atol=1e-12)


def test_positive_angles_on_the_outline_increase_the_area():
    tissue = cluster(8, 1)
    total = lambda angle: with_angles(tissue, jnp.full(tissue.n_edges, angle)).areas.sum()
    assert total(-0.5) < total(0.0) < total(0.5)
    straight = vx.Tissue(tissue.vertices, tissue.topology, vx.Free())
    # (One of the cells has area 0 up to rounding.)
    flat = with_angles(tissue, 0 * angles_of(tissue))
    np.testing.assert_allclose(flat.areas, straight.areas, atol=1e-14)
    assert isinstance(straight.configuration, jax.Array)
    assert not straight.is_arc.any()
    np.testing.assert_array_equal(straight.edge_angles, 0)


def test_geometry_of_a_disc_of_two_cells():
    tissue = with_angles(doublet(), jnp.full(3, np.pi / 2))  # the angle of the interface is ignored
    np.testing.assert_allclose(tissue.areas, np.pi / 8, rtol=1e-14)
    np.testing.assert_allclose(tissue.perimeters, np.pi / 2 + 1, rtol=1e-14)
    np.testing.assert_allclose(
        tissue.centroids, [[-2 / 3 / np.pi, 0], [2 / 3 / np.pi, 0]], atol=1e-15
    )
    np.testing.assert_allclose(tissue.edge_curvatures, [2, 0, 2], rtol=1e-14)


def test_angles_of_straight_edges_are_ignored_and_fixed():
    tissue = cluster(6, 2)
    inner = ~tissue.is_arc
    other = with_angles(tissue, jnp.where(inner, 17.0, angles_of(tissue)))
    np.testing.assert_array_equal(other.areas, tissue.areas)
    vertices, scaled = other.configuration
    moved = other.with_configuration((vertices, scaled + 1.0))
    np.testing.assert_array_equal(np.asarray(moved.angles)[inner], 17.0)
    drift = np.asarray(other.drift((vertices, scaled + 1.0)))[3:]
    np.testing.assert_allclose(drift, inner)


@eqx.filter_jit
def derivatives(tissue, energy, y, direction):
    """The energy, its gradient, and its second derivative along a direction."""
    f = lambda y: energy(tissue.with_configuration(y))
    gradient, product = jax.jvp(jax.grad(f), (y,), (direction,))
    return f(y), gradient, product


@pytest.mark.parametrize("inner_arcs", [False, True])
@pytest.mark.parametrize("angle", [None, 0.0, -0.7, 2.0])
def test_forces_and_hessian_agree_with_finite_differences(inner_arcs, angle):
    tissue = cluster(5, 4, inner_arcs=inner_arcs)
    if angle is not None:  # exactly straight, concave, beyond a semicircle
        tissue = with_angles(tissue, jnp.full(tissue.n_edges, angle))
    energy = (
        AreaElasticity(2.0, 0.9)
        + PerimeterElasticity(0.3, 3.5)
        + LineTension(jnp.linspace(1, 2, 12))
    )
    y = tissue.configuration
    direction, probe = random_like(y), random_like(y, 1)
    dot = lambda a, b: sum(np.sum(np.asarray(p) * np.asarray(q)) for p, q in zip(a, b, strict=True))
    at = lambda y: derivatives(tissue, energy, y, direction)
    _, gradient, product = at(y)
    assert dot(gradient, direction) == pytest.approx(
        float(central_difference(lambda y: at(y)[0], y, direction)), rel=1e-7, abs=1e-8
    )
    along = lambda y: dot(at(y)[1], probe)
    assert dot(product, probe) == pytest.approx(
        central_difference(along, y, direction), rel=1e-6, abs=1e-7
    )


@pytest.mark.parametrize("curved", [False, True])
def test_forces_and_torque_sum_to_zero(curved):
    tissue = cluster(15, 3, random_angles=True, inner_arcs=curved)
    energy = ShapeFactorEnergy(jnp.linspace(3.4, 4.0, 15)) + LineTension(jnp.linspace(0, 1, 42))
    force, _ = forces(tissue, energy)
    np.testing.assert_allclose(force.sum(0), 0, atol=1e-11)
    x = tissue.vertices
    assert jnp.sum(x[:, 0] * force[:, 1] - x[:, 1] * force[:, 0]) == pytest.approx(0, abs=1e-11)


def test_periodic_tissue_with_arcs():
    straight = random_tissue(9, 1)
    tissue = vx.Tissue(
        straight.vertices,
        straight.topology,
        straight.boundary,
        angles=jnp.zeros(27),
        inner_arcs=True,
    )
    np.testing.assert_allclose(tissue.areas, straight.areas)
    bent = with_angles(tissue, 0.3 * jax.random.normal(jax.random.key(0), (27,)))
    assert bent.areas.sum() == pytest.approx(9, rel=1e-12)
    assert jnp.abs(bent.areas - straight.areas).max() > 1e-3
    assert (bent.edge_lengths > straight.edge_lengths).all()


def test_euler_formula_of_a_topology_with_an_exterior():
    tissue = cluster(20, 0)
    m = tissue.topology
    assert (m.n_cells, m.n_faces) == (20, 21)
    assert m.n_vertices - m.n_edges + m.n_faces == 2
    assert m.neighbour_counts.sum() == m.n_half_edges - outline_length(tissue)
    assert (m.edge_cells[:, 0] < 20).all()
    np.testing.assert_array_equal(m.edge_cells[:, 1] == 20, m.on_outline)


def test_invalid_topologies_with_an_exterior_are_rejected():
    m = cluster(6, 0).topology
    twin, cell, frame = (np.array(x) for x in (m.twin, m.cell, m.frame))
    frame[0] = 1
    with pytest.raises(ValueError, match="`frame`"):
        vx.Topology(twin, cell, frame, exterior=True)
    # Two clusters with one exterior.
    n = len(twin)
    both = np.where(cell < 6, cell + 6, 12)
    with pytest.raises(ValueError, match=r"one face|one piece"):
        vx.Topology(
            np.concatenate([twin, twin + n]),
            np.concatenate([np.where(cell < 6, cell, 12), both]),
            np.zeros((2 * n, 2), int),
            exterior=True,
        )
    # The Euler characteristic of a torus is not that of a sphere.
    periodic = random_tissue(6).topology
    with pytest.raises(ValueError, match="must be 1 for a free tissue, but is -1"):
        vx.Topology(periodic.twin, periodic.cell, periodic.frame, exterior=True)
    with pytest.raises(ValueError, match="must be 0 for a periodic tissue, but is 2"):
        vx.Topology(m.twin, m.cell, m.frame)


def test_invalid_arguments_are_rejected():
    free, periodic = cluster(4), random_tissue(4)
    n_edges, n_vertices = free.n_edges, free.n_vertices
    make = lambda **options: vx.Tissue(free.vertices, free.topology, vx.Free(), **options)
    for options, message in (
        ({"angles": jnp.zeros(3)}, rf"`angles` must have shape \({n_edges},\)"),
        ({"angles": jnp.full(n_edges, jnp.nan)}, "`angles` must be finite"),
        ({"pinned": jnp.zeros(2, bool)}, rf"`pinned` must have shape \({n_vertices},\)"),
        ({"angles": jnp.zeros(n_edges), "angle_length": 0.0}, "`angle_length` must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            make(**options)
    with pytest.raises(ValueError, match="must be Free"):
        vx.Tissue(free.vertices, free.topology, periodic.boundary)
    with pytest.raises(ValueError, match="must be Free"):
        vx.Tissue(periodic.vertices, periodic.topology, vx.Free())
    with pytest.raises(ValueError, match="periodic tissue has none"):
        vx.Tissue(periodic.vertices, periodic.topology, periodic.boundary, angles=jnp.zeros(12))
    with pytest.raises(ValueError, match=r"at least 2.*single free cell"):
        vx.initialise.free_voronoi(1, key=jax.random.key(0))
    with pytest.raises(ValueError, match="at least 0"):
        vx.initialise.free_voronoi(3, key=jax.random.key(0), lloyd_steps=-1)


@pytest.mark.thorough
@few
@given(st.sampled_from([2, 9, 60]), st.integers(0, 2**16), st.integers(0, 2))
@example(60, 1, 0)  # before the repair its arcs overlap
def test_free_voronoi_clusters_are_valid(n, seed, lloyd_steps):
    tissue = cluster(n, seed, lloyd_steps=lloyd_steps)
    tissue.topology.validate()
    assert (tissue.n_cells, tissue.n_vertices) == (n, 2 * n - 2)
    assert (tissue.areas > 0).all()
    # The angle is limited, because a circle over a very short chord may be larger than its cell.
    assert jnp.abs(tissue.edge_angles).max() <= 0.9 * np.pi
    random = cluster(n, seed, lloyd_steps=lloyd_steps, random_angles=True)
    np.testing.assert_array_equal(random.vertices, tissue.vertices)
    assert ((random.edge_angles[random.is_arc] < np.pi / 2) & (angles_of(random) > 0).all()).all()


def test_regular_clusters_have_cells_of_mean_area_one():
    areas = jnp.concatenate([cluster(40, seed, lloyd_steps=10).areas for seed in range(4)])
    assert areas.mean() == pytest.approx(1, abs=0.1)
    assert areas.std() < 0.25
