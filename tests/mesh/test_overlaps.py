"""Overlaps agree with a brute-force test."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brute_force_overlaps import faces_that_overlap
from free_helpers import cluster
from hypothesis import example, given, settings, strategies as st

import vertax as vx
from vertax.mesh._overlaps import _last, crossed_sides, loop_over_side_pairs

overlaps_of = eqx.filter_jit(lambda tissue: tissue.overlaps)
PERIODIC = vx.initialise.periodic_voronoi(n_cells=12, key=1)
FREE = cluster(8, 1)


def faces(overlaps) -> list[int]:
    cells = np.flatnonzero(overlaps.cells).tolist()
    return cells + [len(overlaps.cells)] * bool(overlaps.exterior)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0, 0.6), sheared=st.booleans())
def test_overlaps_of_periodic_tissues_agree_with_brute_force(seed, size, sheared):
    lattice = np.asarray(PERIODIC.boundary.lattice) @ np.array([[1.0, 0.0], [0.4 * sheared, 1.0]])
    vertices = np.asarray(PERIODIC.vertices) @ np.array([[1.0, 0.0], [0.4 * sheared, 1.0]])
    moves = size * np.random.default_rng(seed).normal(size=vertices.shape)
    tissue = eqx.tree_at(
        lambda t: (t.vertices, t.boundary.lattice),
        PERIODIC,
        (jnp.asarray(vertices + moves), jnp.asarray(lattice)),
    )
    assert faces(overlaps_of(tissue)) == faces_that_overlap(tissue)


@pytest.mark.thorough
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0, 0.5), bend=st.floats(0, 1.2))
@example(seed=446, size=0.0, bend=1.0486)
@example(seed=102, size=0.0, bend=0.90625)
def test_overlaps_of_free_tissues_agree_with_brute_force(seed, size, bend):
    rng = np.random.default_rng(seed)
    moves = size * rng.normal(size=FREE.vertices.shape)
    angles = np.clip(np.asarray(FREE.angles) + bend * rng.normal(size=FREE.n_edges), -2.8, 2.8)
    tissue = FREE.with_vertices(FREE.vertices + moves).with_angles(jnp.asarray(angles))
    overlapping = faces(overlaps_of(tissue))
    # Arcs that barely touch, or cross by 1e-8 as in the second example, need fine polygons.
    assert overlapping in (faces_that_overlap(tissue, points) for points in (160, 600))


def test_a_corner_beyond_the_opposite_side_is_an_overlap():
    tissue = vx.initialise.hexagonal(2, 2)
    assert not overlaps_of(tissue).any
    assert overlaps_of(tissue).describe() == ""
    m = tissue.topology
    cell = np.flatnonzero(np.asarray(m.cell) == 0)
    corner, opposite = np.asarray(tissue.corners)[cell[0]], np.asarray(tissue.centroids)[0]
    moved = tissue.with_vertices(tissue.vertices.at[cell[0] // 3].add(2.4 * (opposite - corner)))
    overlaps = overlaps_of(moved)
    assert overlaps.any
    assert overlaps.cells[0]
    assert not np.all(overlaps.cells)
    assert overlaps.sides[overlaps.crossed[jnp.argmax(overlaps.sides)]]
    assert "cell 0" in overlaps.describe()
    assert f"{cell[0] // 3}" in overlaps.describe()


def test_collinear_sides_do_not_cross():
    # In a row of bricks, consecutive edges are collinear up to rounding.
    tissue = vx.initialise.hexagonal(4, 4)
    lines = np.round(np.asarray(tissue.vertices)[:, 1] / 0.31) * 0.31
    bricks = tissue.with_vertices(tissue.vertices.at[:, 1].set(lines))
    assert faces(overlaps_of(bricks)) == faces_that_overlap(bricks)


def test_cells_inside_out_are_overlaps():
    tissue = PERIODIC
    mirrored = eqx.tree_at(
        lambda t: (t.vertices, t.boundary.lattice),
        tissue,
        (
            tissue.vertices * jnp.array([-1.0, 1.0]),
            tissue.boundary.lattice * jnp.array([-1.0, 1.0]),
        ),
    )
    overlaps = overlaps_of(mirrored)
    assert np.all(overlaps.cells)
    assert not np.any(overlaps.sides)


def test_overlaps_vmap_over_tissues():
    moved = PERIODIC.with_vertices(PERIODIC.vertices.at[3].add(2.0))
    both = jax.tree.map(lambda *x: jnp.stack(x), PERIODIC, moved)
    overlaps = eqx.filter_vmap(lambda t: t.overlaps)(both)
    assert overlaps.any.tolist() == [False, True]
    one = overlaps_of(moved)
    assert overlaps.describe() == one.describe() != ""
    np.testing.assert_array_equal(overlaps.crossed[1], one.crossed)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_initial_tissues_do_not_overlap(dtype):
    for tissue in (PERIODIC, FREE):
        cast = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tissue)
        assert not overlaps_of(cast).any


@pytest.mark.thorough
@pytest.mark.parametrize("spare", [0, 3])
def test_loop_over_side_pairs_in_pieces_agrees_with_one_loop(spare):
    tissue = cluster(30, seed=2).with_capacity(30 + spare)
    shaken = tissue.vertices + 0.25 * jax.random.normal(jax.random.key(0), tissue.vertices.shape)
    tissue = tissue.with_vertices(shaken)
    m, n = tissue.topology, tissue.topology.n_half_edges
    last = _last(m)
    assert n > 2 * 64  # the size of a piece
    assert last.max() > 12

    def visited(few_long):
        def body(pair, carry):
            count, total = carry
            paired = pair.other != pair.half_edge
            product = jnp.sum(pair.side[:, :2] * pair.other_side[:, 2:4], axis=-1)
            return count + paired, total + jnp.where(paired, pair.k * pair.other + product, 0.0)

        start, half_edges = (jnp.zeros(n, int), jnp.zeros(n)), jnp.arange(n, dtype=m.next.dtype)
        return loop_over_side_pairs(
            tissue.sides_of, m.next, half_edges, last, body, start, few_long=few_long
        )

    both = [jax.jit(visited, static_argnums=0)(few_long) for few_long in (False, True)]
    np.testing.assert_array_equal(both[0][0], jnp.maximum(last, 0))
    np.testing.assert_array_equal(both[0][0], both[1][0])
    np.testing.assert_allclose(both[0][1], both[1][1], rtol=1e-12)
    crossed = [crossed_sides(tissue.sides, m.next, last, few_long=x) for x in (False, True)]
    assert (crossed[0] != jnp.arange(n)).any()
    np.testing.assert_array_equal(crossed[0], crossed[1])
