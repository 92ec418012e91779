"""T1 transitions against the length of steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_CONTACT, random_tissue

import vertax as vx
from vertax.dissipations import SubstrateFriction
from vertax.energies import ShapeFactorEnergy


def quenched(n_steps, duration=0.4):
    """Edges and times of the transitions of a random tissue on its way to rest, and its energies."""
    p0 = 3.5 + 0.1 * jax.random.normal(jax.random.key(1), (16,))
    times = duration * np.arange(n_steps + 1) / n_steps
    # Frame by frame: one program serves all lengths of steps.
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
def test_transitions_and_their_times_do_not_depend_on_short_steps():
    runs = [quenched(n) for n in (100, 200, 400, 800)]
    edges, times, _ = runs[-1]
    assert len(edges) >= 3
    late = []
    for number, (own, when, energies) in enumerate(runs):
        assert (jnp.diff(energies) <= 0).all()
        assert sorted(own) == sorted(edges)
        if number > 0:  # in their order as well, once steps are shorter than what lies between two
            np.testing.assert_array_equal(own, edges)
        at = dict(zip(own.tolist(), when, strict=True))
        late.append(max(abs(at[e] - t) for e, t in zip(edges.tolist(), times, strict=True)))
    # Of first order in the step.
    assert late[2] < 0.6 * late[1] < 0.4 * late[0] + 1e-3
    assert late[0] < 3 * 0.4 / 100
