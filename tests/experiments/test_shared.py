"""Functions that several experiments share."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from experiments._recovery import RecoveryWatch
from experiments._transition import fit_onset, fit_transition
from vertax.costs import mismatched_neighbours
from vertax.fitting import stack

pytestmark = pytest.mark.experiments


def test_the_curve_of_a_transition():
    p0 = np.linspace(3.6, 4.0, 21)
    share = 1 / (1 + np.exp(-(p0 - 3.83) / 0.03))
    result = fit_transition(p0, 1e4 * share, 10_000)
    assert result.centre == pytest.approx(3.83, abs=1e-4)
    assert result.width == pytest.approx(0.03, rel=1e-2)
    # A step between two values lies between them.
    step = fit_transition(p0, 100.0 * (p0 > 3.81), 100)
    assert 3.80 <= step.centre <= 3.82
    assert np.isnan(fit_transition(p0, np.zeros(21), 100).centre)


def test_the_onset_is_where_the_root_of_the_energy_ends():
    p0 = np.linspace(3.6, 4.0, 21)
    spread = 1 + 0.1 * np.random.default_rng(0).standard_normal((21, 40))
    energies = np.maximum(3.85 - p0, 0)[:, None] ** 2 * spread**2
    onset = fit_onset(p0, energies)
    assert onset is not None
    assert onset.centre == pytest.approx(3.85, abs=0.01)
    assert onset.width == pytest.approx(1, rel=0.1)
    assert fit_onset(p0, 0 * energies) is None


def test_bad_counts_are_refused():
    with pytest.raises(ValueError, match="`successes` must lie in 0 … 10"):
        fit_transition(np.linspace(3.6, 4.0, 3), np.array([0.0, 5.0, 11.0]), 10)
    with pytest.raises(ValueError, match="equally many entries, at least 2"):
        fit_transition(np.array([3.8]), np.array([1.0]), 10)


def test_the_watch_counts_what_differs():
    targets = [random_tissue(8, 0), random_tissue(8, 1)]
    truth = vx.energies.ShapeFactorEnergy(3.7 + 0.1 * jnp.arange(16.0).reshape(2, 8))
    tissues = stack([targets[0], random_tissue(8, 2)])
    watch = RecoveryWatch(truth, stack(targets))
    numbers, counts, flags = jnp.zeros(2), jnp.zeros(2, int), jnp.ones(2, bool)
    names = ("cost", "max_force", "relative_error")
    slopes = ("gradient_norm", "gradient_residual", "gradient_steps")
    record = vx.Record(
        parameters=eqx.filter(truth, eqx.is_array),
        tissue=tissues,
        converged=flags,
        num_steps=counts,
        num_t1=counts,
        result=vx.RESULTS.successful,
        **dict.fromkeys((*names, *slopes), numbers),
    )
    notes = watch(0, record)
    np.testing.assert_allclose(notes["pearson"], 1)
    expected = mismatched_neighbours(random_tissue(8, 2), targets[1])
    np.testing.assert_array_equal(notes["mismatched"], [0, expected])
    assert expected > 0
    np.testing.assert_array_equal(watch(1, record)["mismatched"], notes["mismatched"])
