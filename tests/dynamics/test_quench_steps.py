"""Convergence of T1 transitions with the time step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_CONTACT, random_tissue

import vertax as vx
from vertax.dissipations import SubstrateFriction
from vertax.energies import ShapeFactorEnergy


def quenched(n_steps, duration=0.4):
    """Edges and times of the transitions of a random tissue during its relaxation, and its energies."""
    p0 = 3.5 + 0.1 * jax.random.normal(jax.random.key(1), (16,))
    times = duration * np.arange(n_steps + 1) / n_steps
    # `progress=True` computes frame by frame, with one compiled function for all time steps.
    movie = vx.evolve(
        random_tissue(16, 5),
        ShapeFactorEnergy(p0),
        SubstrateFriction(1.0),
        times,
        relaxation=NO_CONTACT,
        progress=True,
    )
    frames, edges = np.nonzero(np.asarray(movie.flipped))
    assert len(edges) == movie.num_t1
    return edges, times[frames], movie.energies


@pytest.mark.slow  # 1500 steps
def test_transition_times_converge_with_the_time_step():
    runs = [quenched(n) for n in (100, 200, 400, 800)]
    edges, times, _ = runs[-1]
    assert len(edges) >= 3
    max_time_errors = []
    for number, (flipped_edges, flip_times, energies) in enumerate(runs):
        assert (jnp.diff(energies) <= 0).all()
        assert sorted(flipped_edges) == sorted(edges)
        if (
            number > 0
        ):  # also in the same order, if time steps are shorter than the intervals between transitions
            np.testing.assert_array_equal(flipped_edges, edges)
        time_of = dict(zip(flipped_edges.tolist(), flip_times, strict=True))
        max_time_errors.append(
            max(abs(time_of[e] - t) for e, t in zip(edges.tolist(), times, strict=True))
        )
    # The error is of first order in the time step.
    assert max_time_errors[2] < 0.6 * max_time_errors[1] < 0.4 * max_time_errors[0] + 1e-3
    assert max_time_errors[0] < 3 * 0.4 / 100
