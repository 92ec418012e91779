"""Whether a fit came to its end."""

import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.fitting import doubts, limits, stack_fits


def fitted(**curves):
    """The parts of a fit that tell what limits it."""
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
def test_what_limits_a_design_is_named(curves, word):
    assert word in limits(fitted(**curves), np.array(False))
    assert limits(fitted(**curves), np.array(True)) == "reached"


def test_a_fit_that_is_at_its_end_leaves_no_doubt():
    assert doubts(fitted(cost=np.exp(-np.arange(20.0)))) == []
    # Nor does one that began at its end.
    assert doubts(fitted()) == []


def test_what_is_not_at_its_end_is_named_with_the_remedy():
    assert doubts(fitted(cost=np.linspace(2, 1, 20))) == [
        "the cost was still falling at the last epoch (raise the number of epochs)"
    ]
    (doubt,) = doubts(fitted(converged=np.arange(20) < 15))
    assert doubt.startswith("relaxations ended before equilibrium")
    # What did not converge is no cost to go by.
    assert doubts(fitted(cost=np.linspace(2, 1, 20), converged=np.arange(20) < 1))[1:] == []


def test_of_a_batch_the_members_are_counted():
    falling, done = fitted(cost=np.linspace(2, 1, 20)), fitted()
    (doubt,) = doubts(stack_fits([falling, done, falling]))
    assert "in 2 of 3 members" in doubt
    assert limits(stack_fits([falling, done]), np.array([False, True]))[1] == "reached"
