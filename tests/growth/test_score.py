"""Score-function gradients of expectations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vertax as vx
from vertax.growth import GrowAndDivide, grow, score_function


def test_gradient_is_that_of_the_expectation():
    keys = jax.random.split(jax.random.key(0), 20_000)

    def mean(p, with_score):
        def one(key):
            x = jax.random.uniform(key) < p
            value = jnp.where(x, p**2 + 1, 0.0)
            return value, jnp.log(jnp.where(x, p, 1 - p))

        values, log_p = jax.vmap(one)(keys)
        return score_function(values, log_p) if with_score else jnp.mean(values)

    p = jnp.asarray(0.3)
    assert mean(p, True) == pytest.approx(float(mean(p, False)))
    # The expectation is p (p² + 1). Without the score its derivative lacks the change of the probability.
    assert jax.grad(mean)(p, True) == pytest.approx(3 * 0.09 + 1, rel=0.03)
    assert jax.grad(mean)(p, False) == pytest.approx(2 * 0.09, rel=0.05)


def test_invalid_shapes_are_rejected(without_type_checks):
    with pytest.raises(ValueError, match="one entry per run"):
        score_function(jnp.ones(3), jnp.ones(2))
    with pytest.raises(ValueError, match="`baseline`"):
        score_function(jnp.ones(1), jnp.ones(1))
    assert score_function(jnp.ones(1), jnp.ones(1), baseline=0.0) == 1


def test_log_likelihood_of_deaths_matches_its_formula():
    tissue = vx.initialise.free_voronoi(4, key=0).with_capacity(6)
    rate, dt = jnp.asarray(0.4), jnp.asarray(0.5)

    def log_p(rate, dying):
        cycle = GrowAndDivide(0.1, 1.5, death_rate=rate)
        before = cycle.init(tissue, jax.random.key(0))
        after = eqx.tree_at(lambda c: c.dying, before, dying)
        return cycle.log_likelihood(before, after, tissue, dt)

    dying = jnp.array([True, False, False, True, True, False])  # of the four living cells, two die
    probability = 1 - np.exp(-0.2)
    assert log_p(rate, dying) == pytest.approx(2 * np.log(probability) - 2 * 0.2)
    slope = 2 * 0.5 * (1 - probability) / probability - 2 * 0.5
    assert jax.grad(log_p)(rate, dying) == pytest.approx(slope)
    no_deaths = jnp.zeros(6, bool)
    assert log_p(jnp.asarray(0.0), no_deaths) == 0
    assert jax.grad(log_p)(jnp.asarray(0.0), no_deaths) == pytest.approx(-4 * 0.5)


@pytest.mark.slow
def test_death_rate_gradient_is_that_of_the_expectation():
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

        values, log_p = jax.vmap(one)(keys)
        return jnp.where(with_score, score_function(values, log_p), jnp.mean(values))

    # A cell starts to die before time 1 with probability 1 - exp(-rate).
    rate = jnp.asarray(0.5)
    assert mean(rate, True) == pytest.approx(1 - np.exp(-0.5), abs=0.03)
    assert jax.grad(mean)(rate, True) == pytest.approx(np.exp(-0.5), abs=0.08)
    assert jax.grad(mean)(rate, False) == 0
