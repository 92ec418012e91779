"""The log density of parameters."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("blackjax", reason='needs the extra: pip install -e ".[bayes]"')

import equinox as eqx
import numpyro.distributions as dist
from bayes_helpers import MEAN, N_CELLS, PRIOR, SPREAD, noisy_problem, padded
from helpers import fine_difference, random_like
from scipy import stats

import vertax as vx
from vertax import bayes


def with_fitted_noise(problem, **options):
    prior = PRIOR | {"noise": dist.LogNormal(jnp.log(0.02), 1.0)}
    return bayes.LogPosterior(problem, prior, lambda p: p["noise"], **options)


@pytest.fixture(scope="module")
def problem():
    return noisy_problem(0.01)[0]


@pytest.mark.thorough
def test_gradient_matches_finite_differences(problem):
    density = with_fitted_noise(problem)
    z = density.coordinates_of({"target_shape_factor": jnp.full(N_CELLS, MEAN), "noise": 0.012})
    value = eqx.filter_jit(lambda z: density.log_prior(z)[0] + density.log_likelihood(z)[0])
    direction = random_like(z)
    expected = fine_difference(value, z, direction)
    slope = eqx.filter_jit(eqx.filter_grad(value))(z)
    assert float(jnp.vdot(slope, direction)) == pytest.approx(float(expected), rel=1e-6)


def test_density_is_that_of_prior_and_noise(problem):
    parameters = {"target_shape_factor": jnp.linspace(3.6, 3.7, N_CELLS), "noise": jnp.array(0.02)}
    density = with_fitted_noise(problem)
    energy = vx.energies.ShapeFactorEnergy(parameters["target_shape_factor"])
    residuals = np.asarray(problem.residuals(energy, problem.tissue, None)[0])
    expected = stats.norm(MEAN, SPREAD).logpdf(parameters["target_shape_factor"]).sum()
    expected += stats.lognorm(s=1.0, scale=0.02).logpdf(0.02)
    expected += stats.norm(0, 0.02).logpdf(residuals).sum()
    assert float(density(parameters)) == pytest.approx(expected, rel=1e-9)
    # In real coordinates the density has the factor |dσ/d log σ| = σ.
    z = density.coordinates_of(parameters)
    log_prior, again = density.log_prior(z)
    assert float(again["noise"]) == pytest.approx(0.02)
    real = float(log_prior + density.log_likelihood(z)[0])
    assert real == pytest.approx(expected + np.log(0.02), rel=1e-9)


def test_marginal_noise_is_the_integral_over_the_noise(problem):
    density = bayes.LogPosterior(problem, PRIOR, None)
    parameters = {"target_shape_factor": jnp.full(N_CELLS, 3.63)}
    energy = vx.energies.ShapeFactorEnergy(parameters["target_shape_factor"])
    residuals = np.asarray(problem.residuals(energy, problem.tissue, None)[0])
    log_sigma = np.linspace(np.log(1e-3), np.log(1.0), 4001)
    terms = stats.norm(0, np.exp(log_sigma)[:, None]).logpdf(residuals).sum(1)
    expected = np.log(np.trapezoid(np.exp(terms - terms.max()), log_sigma)) + terms.max()
    assert float(density.likelihood(parameters)[0]) == pytest.approx(expected, rel=1e-6)


def test_any_distribution_serves_as_noise(problem):
    density = bayes.LogPosterior(problem, PRIOR, dist.StudentT(4.0, 0.0, 0.01))
    parameters = {"target_shape_factor": jnp.full(N_CELLS, MEAN)}
    residuals = np.asarray(problem.residuals(problem.energy, problem.tissue, None)[0])
    expected = stats.t(4, 0, 0.01).logpdf(residuals).sum()
    assert float(jnp.sum(density.likelihood(parameters)[0])) == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module")
def exact():
    """A problem with residuals that are exactly 0 at its parameters."""
    return noisy_problem(0.0, truth=jnp.full(N_CELLS, MEAN))[0]


@pytest.mark.thorough
def test_residuals_of_zero_are_measurements(exact):
    parameters = {"target_shape_factor": jnp.full(N_CELLS, MEAN)}
    n = 2 * exact.tissue.n_vertices
    density = bayes.LogPosterior(exact, PRIOR, 0.01)
    terms, outcome = density.likelihood(parameters)
    assert outcome.measured.all()
    assert float(jnp.sum(terms)) == pytest.approx(n * stats.norm(0, 0.01).logpdf(0))
    # The same tissue with spare slots has the same measurements.
    roomy = padded(exact, N_CELLS + 2)
    terms, outcome = bayes.LogPosterior(roomy, PRIOR, 0.01).likelihood(
        {"target_shape_factor": jnp.full(N_CELLS + 2, MEAN)}
    )
    assert int(jnp.sum(outcome.measured)) == n
    assert float(jnp.sum(terms)) == pytest.approx(n * stats.norm(0, 0.01).logpdf(0))


@pytest.mark.thorough
def test_marginal_density_of_an_exact_fit_is_finite(exact):
    density = bayes.LogPosterior(exact, PRIOR, None)
    value = lambda p: density.likelihood({"target_shape_factor": p})[0]
    at, slope = eqx.filter_jit(eqx.filter_value_and_grad(value))(jnp.full(N_CELLS, MEAN))
    assert jnp.isfinite(at)
    assert jnp.isfinite(slope).all()
    assert at > value(jnp.full(N_CELLS, MEAN + 1e-3))


@pytest.mark.thorough
def test_parameters_outside_the_prior_have_density_zero(problem):
    limited = {"target_shape_factor": dist.Uniform(3.0, 3.6)}
    density = bayes.LogPosterior(problem, limited, 0.01)
    outside = {"target_shape_factor": jnp.full(N_CELLS, MEAN)}
    inside = {"target_shape_factor": jnp.full(N_CELLS, 3.59)}
    assert density(outside) == eqx.filter_jit(density)(outside) == -np.inf
    assert jnp.isfinite(density(inside))
    for start in (None, outside):
        with pytest.raises(
            ValueError, match=r"3\.65 of 'target_shape_factor' lies outside its prior"
        ):
            bayes.Laplace(density, start)


@pytest.mark.parametrize("prior", [dist.HalfNormal(1.0), dist.Normal(0.0, 1.0)])
def test_noise_that_is_not_positive_has_density_zero(problem, prior):
    density = bayes.LogPosterior(problem, PRIOR | {"noise": prior}, lambda p: p["noise"])
    parameters = {"target_shape_factor": jnp.full(N_CELLS, MEAN), "noise": jnp.array(-0.1)}
    assert density(parameters) == -np.inf


def test_noise_of_another_shape_than_the_residuals_is_rejected(problem):
    n = 2 * problem.tissue.n_vertices
    parameters = {"target_shape_factor": jnp.full(N_CELLS, MEAN)}
    at = lambda noise: jnp.sum(bayes.LogPosterior(problem, PRIOR, noise).likelihood(parameters)[0])
    single = dist.Normal(0.0, 0.01).expand([n])
    expected = at(0.01)
    for noise in (jnp.full(n, 0.01), jnp.full(1, 0.01), single):
        np.testing.assert_allclose(at(noise), expected, rtol=1e-12)
    column = jnp.full((n, 1), 0.01)
    for noise in (column, lambda p: column, jnp.full(3, 0.01), dist.Normal(0.0, column)):
        with pytest.raises(
            ValueError, match=rf"one for each residual, shape \({n},\), but its shape"
        ):
            at(noise)
    joint = dist.MultivariateNormal(jnp.zeros(n), 1e-4 * jnp.eye(n))
    for noise in (single.to_event(1), joint):
        with pytest.raises(
            ValueError, match=r"distribution of one residual, .* Leave out `to_event`"
        ):
            at(noise)


def test_failed_relaxation_has_density_zero(problem):
    response = dataclasses.replace(problem.response, max_steps=1)
    density = bayes.LogPosterior(dataclasses.replace(problem, response=response), PRIOR, 0.01)
    assert float(density({"target_shape_factor": jnp.full(N_CELLS, MEAN)})) > -np.inf
    assert float(density({"target_shape_factor": jnp.linspace(3.4, 3.9, N_CELLS)})) == -np.inf


@pytest.mark.thorough
def test_replicates_of_different_sizes_add_their_likelihoods():
    singles = [noisy_problem(0.01, seed, n)[0] for seed, n in ((1, 5), (2, 6))]
    shared = {"mean": dist.Normal(3.65, 0.1), "noise": dist.LogNormal(-4.0, 1.0)}
    noise = lambda p: p["noise"]

    energy_of = lambda n: lambda p: vx.energies.ShapeFactorEnergy(jnp.full(n, p["mean"]))
    batch = vx.fitting.stack([padded(p, 6) for p in singles])
    together = bayes.LogPosterior(batch, shared, noise, energy=energy_of((2, 6)))
    parameters = {"mean": jnp.array(3.7), "noise": jnp.array(0.02)}
    expected = sum(
        float(
            jnp.sum(
                bayes.LogPosterior(p, shared, noise, energy=energy_of(n)).likelihood(parameters)[0]
            )
        )
        for p, n in zip(singles, (5, 6), strict=True)
    )
    terms, outcome = together.likelihood(parameters)
    assert outcome.converged
    assert float(jnp.sum(terms)) == pytest.approx(expected, rel=1e-6)
    value = eqx.filter_jit(lambda z: together.log_likelihood(z)[0])
    z = together.coordinates_of(parameters)
    slope = eqx.filter_jit(eqx.filter_grad(value))(z)
    difference = fine_difference(value, z, jnp.ones(2))
    assert float(jnp.sum(slope)) == pytest.approx(float(difference), rel=1e-6)


def test_topology_is_kept_unless_transitions_are_allowed(problem):
    problem = dataclasses.replace(problem, response=vx.Relaxation())
    assert bayes.LogPosterior(problem, PRIOR, 0.01).problem.response.transitions is None
    free = bayes.LogPosterior(problem, PRIOR, 0.01, across_t1=True)
    assert isinstance(free.problem.response.transitions, vx.T1)


def test_invalid_arguments_are_rejected(problem, without_type_checks):
    wrong: Any = 3.7
    with pytest.raises(TypeError, match=r"`problem` must be a vertax\.fitting\.InverseProblem"):
        bayes.LogPosterior(wrong, PRIOR, 0.01)
    with pytest.raises(TypeError, match="`prior` must hold distributions by name"):
        bayes.LogPosterior(problem, wrong, 0.01)
    with pytest.raises(TypeError, match=r"prior of 'target_shape_factor' must be a distribution"):
        bayes.LogPosterior(problem, {"target_shape_factor": wrong}, 0.01)
    improper = dist.ImproperUniform(dist.constraints.real, (), ())
    with pytest.raises(ValueError, match="must be a proper distribution"):
        bayes.LogPosterior(problem, {"target_shape_factor": improper}, 0.01)
    with pytest.raises(ValueError, match="must be a proper distribution"):
        bayes.LogPosterior(problem, {"target_shape_factor": dist.Poisson(3.0)}, 0.01)
    with pytest.raises(ValueError, match=r"must name arrays of the energy \(target_shape_factor\)"):
        bayes.LogPosterior(problem, {"p0": dist.Normal(3.7, 0.1)}, 0.01)
    with pytest.raises(ValueError, match=r"must have its shape \(6,\), but has \(3,\)"):
        bayes.LogPosterior(
            problem, {"target_shape_factor": dist.Normal(jnp.full(3, 3.7), 0.1)}, 0.01
        )
    with pytest.raises(ValueError, match="`noise` must be positive"):
        bayes.LogPosterior(problem, PRIOR, -0.01)
    moving = dataclasses.replace(problem, fit_position=True)
    with pytest.raises(
        ValueError, match="`energy` must be given for a problem with `fit_position`"
    ):
        bayes.LogPosterior(moving, PRIOR, 0.01)
    density = bayes.LogPosterior(problem, PRIOR, 0.01)
    for parameters in ({}, {"target_shape_factor": jnp.full(3, 3.7)}):
        with pytest.raises(ValueError, match="`parameters` must have the names and shapes"):
            density(parameters)
    with pytest.raises(ValueError, match="`start` must have the names and shapes"):
        bayes.Laplace(density, {"p0": 3.7})
    with pytest.raises(TypeError, match=r"`log_posterior` must be a vertax\.bayes\.LogPosterior"):
        bayes.Laplace(problem)
