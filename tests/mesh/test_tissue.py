"""Geometry of periodic tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue, tissues
from hypothesis import given, settings, strategies as st
from jax.test_util import check_grads

import vertax as vx

many = settings(max_examples=12, deadline=None)


def with_lattice(tissue, lattice):
    return eqx.tree_at(lambda t: t.boundary.lattice, tissue, jnp.asarray(lattice))


@eqx.filter_jit
def compiled_shape(tissue, vertices):
    moved = tissue.with_configuration(vertices)
    return moved.areas, moved.perimeters, moved.centroids, moved.neighbour_counts, moved.corners


def shape(tissue, vertices=None):
    """Areas, perimeters, centroids, numbers of sides and corners, for given vertices."""
    vertices = tissue.vertices if vertices is None else jnp.asarray(vertices)
    return [np.asarray(x) for x in compiled_shape(tissue, vertices)]


@many
@given(tissues())
def test_areas_sum_to_the_area_of_the_box(recipe):
    tissue = recipe()
    areas = shape(tissue)[0]
    assert areas.sum() == pytest.approx(np.linalg.det(tissue.boundary.lattice), rel=1e-12)
    assert (areas > 0).all()


@many
@given(tissues(), st.floats(-30, 30), st.floats(-30, 30))
def test_geometry_is_invariant_under_translation(recipe, x, y):
    tissue = recipe()
    areas, perimeters, centroids, *_ = shape(tissue)
    moved = shape(tissue, np.asarray(tissue.vertices) + np.array([x, y]))
    np.testing.assert_allclose(moved[0], areas, rtol=1e-10)
    np.testing.assert_allclose(moved[1], perimeters, rtol=1e-12)
    np.testing.assert_allclose(moved[2] - centroids, [[x, y]] * tissue.n_cells, atol=1e-9)


@many
@given(tissues(), st.floats(0, 6.3))
def test_geometry_is_invariant_under_rotation(recipe, angle):
    tissue = recipe()
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turned = with_lattice(tissue, np.asarray(tissue.boundary.lattice) @ turn)
    areas, perimeters, *_ = shape(turned, np.asarray(tissue.vertices) @ turn)
    np.testing.assert_allclose(areas, shape(tissue)[0], rtol=1e-10)
    np.testing.assert_allclose(perimeters, shape(tissue)[1], rtol=1e-11)


@many
@given(tissues(min_cells=2), st.randoms(use_true_random=False))
def test_cells_have_the_order_of_their_seeds(recipe, random):
    tissue = recipe()
    seeds = np.random.default_rng(random.randrange(1000)).random((tissue.n_cells, 2)) @ np.asarray(
        tissue.boundary.lattice
    )
    order = list(range(tissue.n_cells))
    random.shuffle(order)
    make = lambda s: vx.initialise.periodic_voronoi(seeds=s, lattice=tissue.boundary.lattice)
    np.testing.assert_allclose(
        shape(make(seeds[order]))[0], shape(make(seeds))[0][order], rtol=1e-9
    )


@many
@given(tissues(max_cells=12))
def test_geometry_agrees_with_polygon_formulas(recipe):
    tissue = recipe()
    # The polygons from a loop over corners in Python, with the shoelace formula.
    m, (areas, perimeters, centroids, neighbour_counts, corners) = tissue.topology, shape(tissue)
    following, cell = np.asarray(m.next), np.asarray(m.cell)
    for c in range(tissue.n_cells):
        loop = [int(np.flatnonzero(cell == c)[0])]
        while following[loop[-1]] != loop[0]:
            loop.append(int(following[loop[-1]]))
        p = corners[loop]
        q = np.roll(p, -1, axis=0)
        area = 0.5 * np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
        assert areas[c] == pytest.approx(area, rel=1e-10)
        assert perimeters[c] == pytest.approx(
            np.sqrt(((q - p) ** 2).sum(1) + 1e-6).sum(), rel=1e-10
        )
        assert neighbour_counts[c] == len(loop)
        fan = np.stack([np.roll(p, -1, 0)[:-2], np.roll(p, -2, 0)[:-2]])[:, :, :] - p[0]
        weights = 0.5 * (fan[0, :, 0] * fan[1, :, 1] - fan[0, :, 1] * fan[1, :, 0])
        centre = p[0] + ((fan.sum(0) / 3) * weights[:, None]).sum(0) / weights.sum()
        np.testing.assert_allclose(centroids[c], centre, atol=1e-9)


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 7])
def test_shape_factor_of_a_regular_polygon(sides):
    # Move the corners of a cell with this number of sides to a circle.
    for seed in range(30):
        tissue = random_tissue(30, seed, softening=0.0)
        cells = np.flatnonzero(np.asarray(tissue.neighbour_counts) == sides)
        if len(cells) == 0:
            continue
        m = tissue.topology
        h = int(np.flatnonzero(np.asarray(m.cell) == cells[0])[0])
        vertices = np.array(tissue.vertices)
        centre = np.asarray(tissue.centroids)[cells[0]]
        box = np.asarray(tissue.boundary.lattice)
        for k in range(sides):
            angle = 2 * np.pi * k / sides
            corner = centre + 0.3 * np.array([np.cos(angle), np.sin(angle)])
            vertices[h // 3] = corner - np.asarray(m.frame)[h] @ box
            h = int(m.next[h])
        regular = tissue.with_configuration(jnp.asarray(vertices))
        expected = np.sqrt(4 * sides * np.tan(np.pi / sides))
        assert regular.shape_factors[cells[0]] == pytest.approx(expected, rel=1e-12)
        return
    pytest.fail(f"no cell with {sides} sides among the test tissues")


def test_geometry_of_the_hexagonal_lattice():
    tissue = vx.initialise.hexagonal(4, 6, area=2.5, softening=0.0)
    np.testing.assert_allclose(tissue.areas, 2.5, rtol=1e-12)
    np.testing.assert_allclose(tissue.shape_factors, 3.7224194364083982, rtol=1e-12)
    assert (tissue.neighbour_counts == 6).all()
    spacing = np.sqrt(5 / np.sqrt(3))
    seeds = spacing * np.array(
        [[c + 0.5 * (r % 2), r * np.sqrt(3) / 2] for r in range(6) for c in range(4)]
    )
    apart = tissue.boundary.shortest(tissue.centroids - seeds)
    np.testing.assert_allclose(apart, 0, atol=1e-12)


@pytest.mark.parametrize("n_cells", [1, 2, 3])
def test_cells_as_wide_as_the_box(n_cells):
    tissue = random_tissue(n_cells, 5, lattice=np.array([[1.0, 0.0], [0.3, n_cells]]))
    assert tissue.areas.sum() == pytest.approx(n_cells)
    # A cell touches its own image.
    assert any(a == b for a, b in np.asarray(tissue.topology.edge_cells).tolist())


def test_geometry_does_not_depend_on_the_images_of_vertices():
    tissue = random_tissue(9, 1)
    jumps = np.random.default_rng(0).integers(-2, 3, (tissue.n_vertices, 2))
    m = tissue.topology
    frame = np.asarray(m.frame) - np.repeat(jumps, 3, axis=0)
    moved = vx.Tissue(
        tissue.vertices + jumps @ tissue.boundary.lattice,
        vx.Topology(m.twin, m.cell, frame, m.edge),
        tissue.boundary,
    )
    np.testing.assert_allclose(moved.areas, tissue.areas, rtol=1e-10)
    np.testing.assert_allclose(moved.edge_vectors, tissue.edge_vectors, atol=1e-12)


def test_derivatives_of_geometry_agree_with_finite_differences():
    tissue = random_tissue(6, 2)
    names = ("areas", "perimeters", "shape_factors", "centroids", "edge_lengths")

    def f(x, lattice):
        moved = with_lattice(tissue.with_configuration(x), lattice)
        return [getattr(moved, name) for name in names]

    check_grads(
        jax.jit(f),
        (tissue.vertices, tissue.boundary.lattice),
        order=2,
        atol=1e-4,
        rtol=1e-4,
        eps=1e-5,
    )


@pytest.mark.parametrize("softening", [0.0, 1e-3])
def test_derivatives_are_finite_at_a_four_fold_vertex(softening):
    tissue = random_tissue(12, 4, softening=softening)
    _, w = tissue.topology.edge_vertices[3]
    step = tissue.edge_vectors[3]
    merged = tissue.with_configuration(tissue.vertices.at[w].add(-step))
    assert merged.edge_lengths[3] == pytest.approx(softening, abs=1e-12)
    energy = vx.energies.ShapeFactorEnergy(3.7)
    f = lambda x: energy(merged.with_configuration(x))
    direction = jnp.ones_like(merged.vertices)
    slopes = jax.jit(lambda x: jax.jvp(jax.grad(f), (x,), (direction,)))
    first, second = slopes(merged.vertices)
    assert jnp.isfinite(first).all()
    if softening > 0:
        assert jnp.isfinite(second).all()


def test_default_softening_changes_lengths_by_a_millionth():
    soft, sharp = random_tissue(50, 1), random_tissue(50, 1, softening=0.0)
    exact = jnp.linalg.norm(sharp.edge_vectors, axis=1)
    np.testing.assert_allclose(sharp.edge_lengths, exact, rtol=1e-14)
    np.testing.assert_allclose(soft.edge_lengths, jnp.sqrt(exact**2 + 1e-6), rtol=1e-12)
    assert vx.Tissue(soft.vertices, soft.topology, soft.boundary).softening == pytest.approx(
        1e-3, rel=0.3
    )


def test_geometry_of_float32_tissues_is_float32():
    tissue = random_tissue(400, 0)
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    small = jax.tree.map(to32, tissue)
    for name in ("areas", "perimeters", "edge_lengths", "centroids"):
        assert getattr(small, name).dtype == jnp.float32
        np.testing.assert_allclose(
            getattr(small, name), getattr(tissue, name), rtol=2e-5, atol=2e-5
        )


def test_invalid_tissues_are_rejected():
    tissue = random_tissue(5)
    with pytest.raises(ValueError, match="`vertices` must have shape"):
        vx.Tissue(tissue.vertices[:-1], tissue.topology, tissue.boundary)
    with pytest.raises(ValueError, match="`vertices` must be finite"):
        vx.Tissue(tissue.vertices.at[0, 0].set(jnp.nan), tissue.topology, tissue.boundary)
    with pytest.raises(ValueError, match="`softening`"):
        vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, -1.0)
    for lattice in (
        [[1.0, 0.0], [0.0, -1.0]],
        [[1.0, 0.0], [2.0, 0.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
    ):
        with pytest.raises(ValueError, match="`lattice`"):
            vx.Periodic(jnp.array(lattice))
    with pytest.raises(ValueError, match="`lattice` must have shape"):
        vx.Periodic(jnp.ones(2))


@many
@given(tissues(), st.integers(-3, 3), st.integers(-3, 3), st.integers(0, 100))
def test_shortest_displacement_agrees_with_brute_force(recipe, i, j, seed):
    tissue = recipe()
    boundary = tissue.boundary
    d = np.random.default_rng(seed).uniform(-1, 1, (5, 2)) @ np.asarray(boundary.lattice)
    grid = np.array([(a, b) for a in range(-6, 7) for b in range(-6, 7)]) @ np.asarray(
        boundary.lattice
    )
    brute = np.linalg.norm(d[:, None] + grid, axis=-1).min(axis=1)
    short = boundary.shortest(jnp.asarray(d) + boundary.translation(jnp.array([i, j])))
    np.testing.assert_allclose(np.linalg.norm(short, axis=-1), brute, atol=1e-10)
