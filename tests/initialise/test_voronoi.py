import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import lattices, random_tissue
from hypothesis import given, settings, strategies as st

import vertax as vx

voronoi = vx.initialise.periodic_voronoi


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([1, 2, 3, 6, 17, 40]), st.integers(0, 10**6), st.data())
def test_vertices_are_equally_far_from_three_seeds_and_no_other_is_closer(n, seed, data):
    lattice = data.draw(lattices(n))
    seeds = np.random.default_rng(seed).random((n, 2)) @ lattice
    tissue = voronoi(seeds=seeds, lattice=lattice)
    grid = np.array([(i, j) for i in range(-4, 5) for j in range(-4, 5)]) @ lattice
    images = (seeds[None] + grid[:, None]).reshape(-1, 2)
    distance = np.sort(
        np.linalg.norm(np.asarray(tissue.vertices)[:, None] - images, axis=-1), axis=1
    )
    np.testing.assert_allclose(distance[:, 2], distance[:, 0], atol=1e-9)
    # and the cell at each corner is the one of the seed that close, in the frame of the cell
    cell = np.asarray(tissue.topology.cell)
    own = np.linalg.norm(np.asarray(tissue.corners) - seeds[cell], axis=1)
    np.testing.assert_allclose(own, np.repeat(distance[:, 0], 3), atol=1e-9)


def test_vertices_lie_in_the_box():
    tissue = random_tissue(50, 0, lattice=np.array([[5.0, 0.0], [2.0, 10.0]]))
    fractions = np.asarray(tissue.vertices) @ np.linalg.inv(np.asarray(tissue.boundary.lattice))
    assert fractions.min() >= -1e-9
    assert fractions.max() < 1 + 1e-9


def test_default_box_has_mean_cell_area_one():
    assert random_tissue(30).boundary.area == pytest.approx(30)


def test_the_same_key_gives_the_same_tissue():
    np.testing.assert_array_equal(random_tissue(30, 4).vertices, random_tissue(30, 4).vertices)
    assert not np.allclose(random_tissue(30, 4).vertices, random_tissue(30, 5).vertices)


@pytest.mark.parametrize("n", [1, 3, 5])
def test_a_square_lattice_of_seeds_is_degenerate_but_works(n):
    seeds = np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1).reshape(-1, 2).astype(float)
    tissue = voronoi(seeds=seeds, softening=0.0)
    np.testing.assert_allclose(tissue.areas, 1, rtol=1e-12)
    np.testing.assert_allclose(tissue.perimeters, 4, rtol=1e-12)


def test_lloyd_steps_even_the_areas_out():
    spread = [float(jnp.std(random_tissue(100, 2, lloyd_steps=k).areas)) for k in (0, 2, 10)]
    assert spread[0] > 1.3 * spread[1] > 1.6 * spread[2]


def test_ten_thousand_cells():
    tissue = random_tissue(10_000, 1)
    assert tissue.n_vertices == 20_000
    assert tissue.areas.sum() == pytest.approx(10_000)


def test_memory_order_follows_space():
    tissue = random_tissue(2000, 1)
    v, w = np.asarray(tissue.topology.edge_vertices).T
    assert np.median(np.abs(v - w)) < 60


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either `n_cells`"),
        ({"n_cells": 3, "seeds": np.zeros((3, 2))}, "either `n_cells`"),
        ({"n_cells": 3}, "`key` is needed"),
        ({"n_cells": 0, "key": jax.random.key(0)}, "at least one cell"),
        ({"seeds": np.zeros((0, 2))}, "at least one cell"),
        ({"seeds": np.zeros(4)}, "`seeds` must have shape"),
        ({"seeds": np.array([[0.1, 0.2], [np.nan, 0.3]])}, "`seeds` must be finite"),
        ({"seeds": np.array([[0.1, 0.2], [0.5, 0.3], [0.1, 0.2]])}, "seeds 0 and 2 coincide"),
        ({"seeds": np.array([[0.0, 0.2], [2.0, 0.2]]), "lattice": 2 * np.eye(2)}, "coincide"),
        ({"n_cells": 3, "key": jax.random.key(0), "lattice": -np.eye(2)[::-1]}, "`lattice`"),
        ({"n_cells": 3, "key": jax.random.key(0), "lloyd_steps": -1}, "`lloyd_steps`"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        voronoi(**options)


@pytest.mark.parametrize(
    ("nx", "ny", "area"), [(0, 3, 1.0), (2, -1, 1.0), (2, 2, 0.0), (2, 2, np.nan)]
)
def test_bad_hexagonal_lattices_are_refused(nx, ny, area):
    with pytest.raises(ValueError, match="must be"):
        vx.initialise.hexagonal(nx, ny, area=area)
