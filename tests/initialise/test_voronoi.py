from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import lattices, random_tissue
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax.initialise import free_voronoi, hexagonal, periodic_voronoi

voronoi = vx.initialise.periodic_voronoi


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([1, 2, 3, 6, 17, 40]), st.integers(0, 10**6), st.data())
def test_vertices_are_circumcentres_of_empty_circles(n, seed, data):
    lattice = data.draw(lattices(n))
    seeds = np.random.default_rng(seed).random((n, 2)) @ lattice
    tissue = voronoi(seeds=seeds, lattice=lattice)
    grid = np.array([(i, j) for i in range(-4, 5) for j in range(-4, 5)]) @ lattice
    images = (seeds[None] + grid[:, None]).reshape(-1, 2)
    distance = np.sort(
        np.linalg.norm(np.asarray(tissue.vertices)[:, None] - images, axis=-1), axis=1
    )
    np.testing.assert_allclose(distance[:, 2], distance[:, 0], atol=1e-9)
    # The cell of each corner is that of the nearest seed, in the frame of the cell.
    cell = np.asarray(tissue.topology.cell)
    distance_to_seed = np.linalg.norm(np.asarray(tissue.corners) - seeds[cell], axis=1)
    np.testing.assert_allclose(distance_to_seed, np.repeat(distance[:, 0], 3), atol=1e-9)


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
def test_a_square_lattice_of_seeds_gives_square_cells(n):
    seeds = np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1).reshape(-1, 2).astype(float)
    tissue = voronoi(seeds=seeds, softening=0.0)
    np.testing.assert_allclose(tissue.areas, 1, rtol=1e-12)
    np.testing.assert_allclose(tissue.perimeters, 4, rtol=1e-12)


def test_lloyd_steps_reduce_the_variance_of_areas():
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
        ({"n_cells": 0, "key": jax.random.key(0)}, "`n_cells` must be at least 1"),
        ({"seeds": np.zeros((0, 2))}, "at least one cell"),
        ({"seeds": np.zeros(4)}, "`seeds` must have shape"),
        ({"seeds": np.array([[0.1, 0.2], [np.nan, 0.3]])}, "`seeds` must be finite"),
        ({"seeds": np.array([[0.1, 0.2], [0.5, 0.3], [0.1, 0.2]])}, "seeds 0 and 2 coincide"),
        ({"seeds": np.array([[0.0, 0.2], [2.0, 0.2]]), "lattice": 2 * np.eye(2)}, "coincide"),
        ({"n_cells": 3, "key": jax.random.key(0), "lattice": -np.eye(2)[::-1]}, "`lattice`"),
        ({"n_cells": 3, "key": jax.random.key(0), "lloyd_steps": -1}, "`lloyd_steps`"),
    ],
)
def test_missing_or_contradictory_arguments_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        voronoi(**options)


@pytest.mark.parametrize(
    ("nx", "ny", "area"), [(0, 3, 1.0), (2, -1, 1.0), (2, 2, 0.0), (2, 2, np.nan)]
)
def test_invalid_hexagonal_lattices_are_rejected(nx, ny, area):
    with pytest.raises(ValueError, match="must be"):
        vx.initialise.hexagonal(nx, ny, area=area)


def test_an_integer_seed_is_a_key(without_type_checks):
    for make in (periodic_voronoi, free_voronoi):
        by_seed, by_key = (make(5, key=key) for key in (3, jax.random.key(3)))
        np.testing.assert_array_equal(by_seed.vertices, by_key.vertices)
    seed: Any = np.int64(3)
    old, new = (periodic_voronoi(5, key=key) for key in (jax.random.PRNGKey(3), seed))
    np.testing.assert_array_equal(old.vertices, new.vertices)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"key": "seed"}, TypeError, "`key` must be a key from jax.random.key"),
        ({"key": 1.5}, TypeError, "`key` must be a key .* but is 1.5"),
        ({"key": True}, TypeError, "`key` must be a key"),
        (
            {"key": jnp.ones(2)},
            TypeError,
            "`key` must be a key .* an array of shape .* and type float",
        ),
        ({"key": 2**64}, ValueError, "`key` must be a seed of at most 64 bits"),
        ({"key": jax.random.split(jax.random.key(0), 3)}, ValueError, r"must be one key.*\(3,\)"),
        (
            {"n_cells": 5.5},
            TypeError,
            "`n_cells` must be at least .*a Python integer.* but is 5.5",
        ),
        ({"n_cells": "5"}, TypeError, "`n_cells` must be at least"),
        ({"n_cells": True}, TypeError, "`n_cells` must be at least"),
        ({"n_cells": 0}, ValueError, "`n_cells` must be at least"),
        ({"lloyd_steps": 1.0}, TypeError, "`lloyd_steps` must be at least 0"),
        ({"lloyd_steps": -1}, ValueError, "`lloyd_steps` must be at least 0"),
    ],
)
@pytest.mark.parametrize("make", [periodic_voronoi, free_voronoi])
def test_arguments_of_wrong_type_are_rejected(make, options, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        make(**{"n_cells": 5, "key": jax.random.key(0)} | options)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"seeds": np.ones((4, 2)) * 1j}, TypeError, "`seeds` must hold real numbers"),
        ({"seeds": [["a", "b"]]}, TypeError, "`seeds` must hold real numbers"),
        ({"seeds": [[1, 2], [3]]}, TypeError, "`seeds` must hold real numbers"),
        ({"n_cells": 5, "key": 0, "lattice": "square"}, TypeError, "`lattice` must hold real"),
        ({"n_cells": 5, "key": 0, "lattice": np.nan * np.eye(2)}, ValueError, "`lattice` must be"),
        ({"n_cells": 5, "key": 0, "lattice": 5.0}, ValueError, r"`lattice` must .* shape \(2, 2\)"),
    ],
)
def test_invalid_seeds_and_lattices_are_rejected(options, error, message, without_type_checks):
    with pytest.raises(error, match=message):
        periodic_voronoi(**options)


@pytest.mark.parametrize("arguments", [(2.5, 4), (4, "4"), (True, 2)])
def test_hexagonal_takes_integers_only(arguments, without_type_checks):
    with pytest.raises(TypeError, match="a Python integer"):
        hexagonal(*arguments)


def test_tracers_are_rejected_with_a_remedy(without_type_checks):
    keys = jax.random.split(jax.random.key(0), 2)
    for make in (lambda key: periodic_voronoi(5, key=key), lambda key: free_voronoi(5, key=key)):
        for transformed in (eqx.filter_vmap(make), lambda keys, f=make: eqx.filter_jit(f)(keys[0])):
            with pytest.raises(TypeError, match=r"does not work inside jax.jit.*jax.numpy.stack"):
                transformed(keys)
    with pytest.raises(TypeError, match="hexagonal needs arrays with concrete values"):
        jax.vmap(lambda area: hexagonal(4, 4, area=area))(jnp.ones(2))
    # The remedy of the message.
    tissues = [periodic_voronoi(5, key=key) for key in keys]
    batch = jax.tree.map(lambda *x: jax.numpy.stack(x), *tissues)
    assert eqx.filter_vmap(lambda tissue: tissue.areas)(batch).shape == (2, 5)


def test_seeds_far_from_the_origin_are_rejected():
    seeds = np.random.default_rng(0).random((5, 2))
    with pytest.raises(ValueError, match=r"`seeds` must lie within 1e.08 boxes of the origin"):
        periodic_voronoi(seeds=seeds * 1e300)
    shifted = periodic_voronoi(seeds=seeds + 1e5 * np.sqrt(5))
    np.testing.assert_allclose(
        np.sort(shifted.areas), np.sort(periodic_voronoi(seeds=seeds).areas), rtol=1e-6
    )
