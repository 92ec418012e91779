"""Gradients of expectations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.growth import GrowAndDivide, grow, score_function


def test_the_mean_is_that_of_the_values_and_its_gradient_that_of_the_expectation():
    keys = jax.random.split(jax.random.key(0), 20_000)

    def mean(p, with_score):
        def one(key):
            x = jax.random.uniform(key) < p
            value = jnp.where(x, p**2 + 1, 0.0)
            return value, jnp.log(jnp.where(x, p, 1 - p))

        values, likely = jax.vmap(one)(keys)
        return score_function(values, likely) if with_score else jnp.mean(values)

    p = jnp.asarray(0.3)
    assert mean(p, True) == pytest.approx(float(mean(p, False)))
    # The expectation is p (p² + 1); runs that stay as they are see only a part of its slope.
    assert jax.grad(mean)(p, True) == pytest.approx(3 * 0.09 + 1, rel=0.03)
    assert jax.grad(mean)(p, False) == pytest.approx(2 * 0.09, rel=0.05)


def test_what_does_not_go_together_is_named(as_a_user):
    with pytest.raises(ValueError, match="one entry per run"):
        score_function(jnp.ones(3), jnp.ones(2))
    with pytest.raises(ValueError, match="`baseline`"):
        score_function(jnp.ones(1), jnp.ones(1))
    assert score_function(jnp.ones(1), jnp.ones(1), baseline=0.0) == 1


def test_how_likely_deaths_are():
    tissue = vx.initialise.free_voronoi(4, key=0).with_capacity(6)
    rate, dt = jnp.asarray(0.4), jnp.asarray(0.5)

    def likely(rate, dying):
        cycle = GrowAndDivide(0.1, 1.5, death_rate=rate)
        before = cycle.init(tissue, jax.random.key(0))
        after = eqx.tree_at(lambda c: c.dying, before, dying)
        return cycle.log_likelihood(before, after, tissue, dt)

    dying = jnp.array([True, False, False, True, True, False])  # of which two there are
    share = 1 - np.exp(-0.2)
    assert likely(rate, dying) == pytest.approx(2 * np.log(share) - 2 * 0.2)
    slope = 2 * 0.5 * (1 - share) / share - 2 * 0.5
    assert jax.grad(likely)(rate, dying) == pytest.approx(slope)
    nobody = jnp.zeros(6, bool)
    assert likely(jnp.asarray(0.0), nobody) == 0
    assert jax.grad(likely)(jnp.asarray(0.0), nobody) == pytest.approx(-4 * 0.5)


@pytest.mark.slow
def test_the_gradient_by_a_rate_of_death_is_that_of_the_expectation():
    tissue = vx.initialise.free_voronoi(4, key=0, lloyd_steps=2).with_capacity(5)
    brief = vx.Relaxation(transitions=None, contact_range=None, max_steps=1)
    energy = lambda cells: vx.energies.AreaElasticity(1.0, cells.target_area)
    keys = jax.random.split(jax.random.key(3), 1000)

    @eqx.filter_jit
    def mean(rate, with_score):
        def one(key):
            cycle = GrowAndDivide(0.0, 9.0, death_rate=rate)
            grown = grow(
                tissue,
                energy,
                cycle,
                jnp.linspace(0.0, 1.0, 3),
                key=key,
                divisions=1,
                relaxation=brief,
                throw=False,
            )
            return jnp.sum(grown.cells.dying & grown.tissue.alive) / 4, grown.log_likelihood

        values, likely = jax.vmap(one)(keys)
        return jnp.where(with_score, score_function(values, likely), jnp.mean(values))

    # A cell has begun to die at time 1 with the probability 1 - exp(-rate).
    rate = jnp.asarray(0.5)
    assert mean(rate, True) == pytest.approx(1 - np.exp(-0.5), abs=0.03)
    assert jax.grad(mean)(rate, True) == pytest.approx(np.exp(-0.5), abs=0.08)
    assert jax.grad(mean)(rate, False) == 0
