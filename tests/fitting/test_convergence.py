"""Convergence warnings of fits."""

import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.fitting import fit_warnings, limits, stack_fits


def fitted(**curves):
    """A fit with given curves; all other curves are constant."""
    n = 20
    history = {
        "converged": np.full(n, True),
        "num_t1": np.zeros(n, int),
        "gradient_norm": np.ones(n),
    }
    names = ("cost", "max_force", "num_steps", "gradient_residual", "gradient_steps")
    history |= dict.fromkeys((*names, "relative_error"), np.ones(n)) | {
        "seconds": np.ones(n),
        "guidance": np.ones(n),
    }
    history["num_steps"] = np.ones(n, int)
    best = curves.pop("best_epoch", 5)
    tissue = vx.initialise.hexagonal(3, 4)
    energy = vx.energies.LineTension(1.0)
    record = vx.History(**history | curves)
    return vx.Fit(energy, tissue, jnp.array(1.0), jnp.array(0.0), np.array(best), record)


@pytest.mark.parametrize(
    ("curves", "word"),
    [
        ({"converged": np.full(20, False)}, "relaxations"),
        ({"cost": np.linspace(2, 1, 20)}, "still falling"),
        ({"num_t1": np.full(20, 3)}, "T1"),
        ({"gradient_norm": np.logspace(0, -9, 20)}, "vanished"),
        ({}, "stopped falling"),
    ],
)
def test_limits_names_the_first_limiting_condition(curves, word):
    assert word in limits(fitted(**curves), np.array(False))
    assert limits(fitted(**curves), np.array(True)) == "reached"


def test_converged_fit_has_no_warnings():
    assert fit_warnings(fitted(cost=np.exp(-np.arange(20.0)))) == []
    # A constant cost counts as converged.
    assert fit_warnings(fitted()) == []


def test_unconverged_fit_has_warnings_with_remedies():
    assert fit_warnings(fitted(cost=np.linspace(2, 1, 20))) == [
        "the cost was still falling at the last epoch (raise the number of epochs)"
    ]
    (warning,) = fit_warnings(fitted(converged=np.arange(20) < 15))
    assert warning.startswith("relaxations ended before equilibrium")
    # Costs of epochs that did not converge are ignored.
    assert fit_warnings(fitted(cost=np.linspace(2, 1, 20), converged=np.arange(20) < 1))[1:] == []


def test_warnings_of_a_batch_count_the_members():
    falling, converged = fitted(cost=np.linspace(2, 1, 20)), fitted()
    (warning,) = fit_warnings(stack_fits([falling, converged, falling]))
    assert "in 2 of 3 members" in warning
    assert limits(stack_fits([falling, converged]), np.array([False, True]))[1] == "reached"
