"""The example of a downstream project in `downstream` works."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from downstream import contraction
from helpers import central_difference, random_tissue


@pytest.mark.thorough
def test_fit_is_saved_and_loaded(tmp_path):
    tissue = random_tissue(4)
    problem = contraction.problem(tissue)
    fit = contraction.fit(problem, tmp_path, epochs=4)
    assert fit.cost < fit.history.cost[0]
    cost, loaded = contraction.load(tmp_path)
    np.testing.assert_allclose(cost, fit.cost, rtol=1e-12)
    value, _ = loaded(tissue=fit.tissue)
    np.testing.assert_allclose(value, fit.cost, rtol=1e-4)
    assert len(json.loads((tmp_path / "cells.geojson").read_text())["features"]) == 4
    assert len((tmp_path / "cells.csv").read_text().splitlines()) == 5


@pytest.mark.thorough
def test_gradient_agrees_with_finite_differences():
    tissue, strength = random_tissue(4), jnp.linspace(0.1, 0.2, 4)
    along = jnp.array([1.0, 0.5, -1.0, 0.3])
    cost = lambda s: jnp.var(contraction.relax(tissue, s).tissue.areas)
    expected = central_difference(cost, strength, along, 1e-4)
    derivative = jax.jit(contraction.gradient)(tissue, strength) @ along
    np.testing.assert_allclose(derivative, expected, rtol=1e-3)
