"""Marginal likelihoods and leave-one-out between energies."""

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("blackjax", reason='needs the extra: pip install -e ".[bayes]"')

import numpyro.distributions as dist
from bayes_helpers import MEAN, N_CELLS, PRIOR, SPREAD, noisy_problem
from helpers import FIXED_TOPOLOGY

import vertax as vx
from vertax import bayes

NOISE = 2e-3
TENSION = dist.Normal(0.0, 0.05)


def uniform_with_tensions(parameters):
    """One target shape factor for all cells, and a line tension of each edge."""
    shape_factors = vx.energies.ShapeFactorEnergy(jnp.full(N_CELLS, parameters["mean"]))
    return shape_factors + vx.energies.LineTension(parameters["tension"])


def densities(problem):
    """The same data under two models: a shape factor per cell; one for all with tension noise."""
    n_edges = problem.tissue.n_edges
    prior = {"mean": dist.Normal(MEAN, SPREAD), "tension": TENSION.expand([n_edges])}
    return [
        bayes.LogPosterior(problem, PRIOR, NOISE),
        bayes.LogPosterior(problem, prior, NOISE, energy=uniform_with_tensions),
    ]


def data_of_tensions(problem, seed):
    tension = TENSION.sample(jax.random.key(seed), (problem.tissue.n_edges,))
    energy = uniform_with_tensions({"mean": jnp.array(MEAN), "tension": tension})
    exact = FIXED_TOPOLOGY(problem.tissue, energy).tissue
    shifts = NOISE * jax.random.normal(jax.random.key(seed + 1), exact.vertices.shape)
    target = exact.with_vertices(exact.vertices + shifts)
    cost = problem.tissue.n_vertices * vx.costs.VertexDistance(target)
    return dataclasses.replace(problem, cost=cost)


@pytest.mark.slow
def test_the_true_model_has_the_larger_evidence():
    by_cell = noisy_problem(NOISE)[0]
    for problem, true in ((by_cell, 0), (data_of_tensions(by_cell, 5), 1)):
        approximations = [bayes.Laplace(density) for density in densities(problem)]
        by_laplace = [float(a.log_evidence) for a in approximations]
        by_smc = [float(bayes.evidence(a, 0)) for a in approximations]
        for values in (by_laplace, by_smc):
            assert values[true] > values[1 - true] + 3, (by_laplace, by_smc)
        np.testing.assert_allclose(by_smc, by_laplace, atol=1.0)


@pytest.mark.slow
def test_leave_one_out_prefers_the_true_model():
    problem = noisy_problem(NOISE)[0]
    one_for_all = lambda p: vx.energies.ShapeFactorEnergy(jnp.full(N_CELLS, p["mean"]))
    prior = {"mean": dist.Normal(MEAN, SPREAD), "noise": dist.LogNormal(np.log(NOISE), 1.0)}
    noise = lambda p: p["noise"]
    narrow = bayes.LogPosterior(problem, prior, noise, energy=one_for_all)
    wide = bayes.LogPosterior(problem, PRIOR | {"noise": prior["noise"]}, noise)
    elpd = []
    for density in (wide, narrow):
        posterior = bayes.sample(density, 0, draws=200, warmup=100, chains=2, progress=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of ArviZ, about influential residuals
            elpd.append(posterior.loo())
    values = [float(getattr(e, "elpd_loo", getattr(e, "elpd", np.nan))) for e in elpd]
    assert values[0] > values[1] + 10


@pytest.mark.slow
def test_evidence_of_a_gaussian_posterior_is_that_of_laplace():
    problem = noisy_problem(1e-3)[0]
    prior = {"mean": dist.Normal(MEAN, 0.05)}
    energy = lambda p: vx.energies.ShapeFactorEnergy(jnp.full(N_CELLS, p["mean"]))
    density = bayes.LogPosterior(problem, prior, 0.05, energy=energy)
    laplace = bayes.Laplace(density)
    by_smc = bayes.evidence(laplace, 0, particles=100, moves=2)
    grid = np.linspace(MEAN - 0.25, MEAN + 0.25, 201)
    at = jax.jit(lambda z: density.log_prior(z)[0] + density.log_likelihood(z)[0])
    values = np.array([float(at(jnp.array([z]))) for z in grid])
    values = np.where(np.isfinite(values), values, -np.inf)
    expected = np.log(np.trapezoid(np.exp(values - values.max()), grid)) + values.max()
    assert float(by_smc) == pytest.approx(expected, abs=0.1)
    assert float(laplace.log_evidence) == pytest.approx(expected, abs=0.1)


def test_invalid_arguments_are_rejected(without_type_checks):
    wrong: Any = 3.0
    with pytest.raises(TypeError, match=r"`laplace` must be a vertax\.bayes\.Laplace"):
        bayes.evidence(wrong, 0)
