"""Synthetic inverse problems, and how well they are solved."""

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import NO_CONTACT, random_tissue

from vertax.inference import (
    pearson,
    relative_error,
    same_neighbours,
    shape_factor_scene,
)


@eqx.filter_jit
def _force(tissue, energy):
    return jax.grad(lambda x: energy(tissue.with_configuration(x)))(tissue.configuration)


def force(tissue, energy):
    return float(np.abs(_force(tissue, energy)).max())


def scene_of(**options):
    """Relaxed without contacts, which compiles less: the experiments have scenes with them."""
    options |= {"response": NO_CONTACT, "target_response": NO_CONTACT}
    return shape_factor_scene(8, key=jax.random.key(0), mean=3.7, deviation=0.05, **options)


@pytest.mark.thorough
def test_target_and_start_are_equilibria():
    scene = scene_of()
    assert scene.converged
    assert force(scene.target, scene.truth) < 1e-8
    assert force(scene.initial, scene.guess) < 1e-8
    assert not np.allclose(scene.truth.target_shape_factor, scene.guess.target_shape_factor)


@pytest.mark.thorough
def test_the_guess_may_be_the_mean_and_relax_from_the_first_tissue():
    scene = scene_of(guess="mean", start="first")
    np.testing.assert_allclose(scene.guess.target_shape_factor, 3.7)
    assert force(scene.initial, scene.guess) < 1e-8


def test_unknown_choices_are_refused():
    with pytest.raises(ValueError, match="`guess` must be one of 'redrawn', 'mean'"):
        shape_factor_scene(8, key=jax.random.key(0), guess="median")


def test_correlation_and_error_of_batches():
    rng = np.random.default_rng(0)
    true = 3.7 + 0.1 * rng.standard_normal((3, 20))
    inferred = true + 0.02 * rng.standard_normal((3, 20))
    expected = [np.corrcoef(a, b)[0, 1] for a, b in zip(true, inferred, strict=True)]
    np.testing.assert_allclose(pearson(true, inferred), expected)
    np.testing.assert_allclose(pearson(true[0], inferred[0]), expected[0])
    np.testing.assert_allclose(relative_error(true, 1.1 * true), 0.1)
    # Of equal values there is no correlation.
    assert np.isnan(pearson(true, np.full_like(true, 3.7))).all()
    with pytest.raises(ValueError, match="one shape"):
        pearson(true, inferred[0])


def test_neighbours_do_not_depend_on_edge_numbers():
    tissue = random_tissue(8, 0)
    assert same_neighbours(tissue, random_tissue(8, 0))
    assert not same_neighbours(tissue, random_tissue(8, 1))
