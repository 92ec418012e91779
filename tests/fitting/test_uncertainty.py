"""Uncertainty of fitted parameters (Laplace approximation)."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import FIXED_TOPOLOGY, p0_of, relaxed

import vertax as vx
from vertax.costs import MeshImage, VertexDistance, render


@pytest.fixture(scope="module")
def hidden():
    return relaxed(8, 3)


NEGLIGIBLE_STEPS = optax.adam(1e-12)


def fitted(tissue, energy, cost):
    """A problem, and a fit that does not change the energy."""
    problem = vx.InverseProblem(tissue, energy, cost, response=FIXED_TOPOLOGY)
    return problem, vx.fit(problem, NEGLIGIBLE_STEPS, 1, progress=False)


@pytest.mark.slow  # sixty fits
def test_deviation_matches_the_scatter_of_repeated_fits(hidden):
    tissue, truth = hidden
    noise = 1e-4

    def noisy_cost(key):
        target = tissue.with_vertices(
            tissue.vertices + noise * jax.random.normal(key, tissue.vertices.shape)
        )
        # Remove the mean of the noise, because no parameter moves the centroid.
        target = target.settled(tissue)
        return VertexDistance(target)

    keys = jax.random.split(jax.random.key(0), 60)
    problems = eqx.filter_vmap(
        lambda key: vx.InverseProblem(tissue, truth, noisy_cost(key), response=FIXED_TOPOLOGY),
        out_axes=eqx.if_array(0),
    )(keys)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    fits = vx.fit(problems, solver, 12, batched=True, progress=False)
    scatter = np.std(np.asarray(p0_of(fits.energy)), axis=0)
    first_member = lambda tree: jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, tree)
    estimate = vx.uncertainty(first_member(problems), first_member(fits))
    np.testing.assert_allclose(p0_of(estimate.deviation), scatter, rtol=0.6)
    mean_ratio = float(np.mean(p0_of(estimate.deviation) / scatter))
    assert 0.75 < mean_ratio < 1.3
    np.testing.assert_allclose(np.diag(estimate.covariance) ** 0.5, p0_of(estimate.deviation))


@pytest.mark.thorough
def test_covariance_matches_its_formula(hidden):
    tissue, truth = hidden
    target = tissue.with_vertices(
        tissue.vertices + 1e-3 * jax.random.normal(jax.random.key(1), tissue.vertices.shape)
    )
    problem, fit = fitted(tissue, truth, VertexDistance(target))
    estimate = vx.uncertainty(problem, fit)

    @jax.jit
    def residuals(p0):
        return problem.residuals(vx.energies.ShapeFactorEnergy(p0), fit.tissue, None)[0]

    p0 = p0_of(fit.energy)
    step = 1e-5 * np.eye(8)
    jacobian = np.stack([(residuals(p0 + e) - residuals(p0 - e)) / 2e-5 for e in step], axis=1)
    residual = np.asarray(residuals(p0))
    expected = np.linalg.inv(jacobian.T @ jacobian) * (residual @ residual) / (len(residual) - 8)
    np.testing.assert_allclose(estimate.covariance, expected, rtol=1e-3, atol=1e-4 * expected.max())
    # A narrow prior dominates the data.
    narrow = vx.uncertainty(problem, fit, prior=1e-7)
    np.testing.assert_allclose(p0_of(narrow.deviation), 1e-7, rtol=1e-2)
    # Fewer independent residuals give larger deviations.
    fewer = vx.uncertainty(problem, fit, n_independent=16)
    assert (p0_of(fewer.deviation) > p0_of(estimate.deviation)).all()


class OneNumber(vx.costs.AbstractLeastSquaresCost):
    """Twenty measurements of the perimeter of one cell."""

    measured_perimeters: jax.Array

    def residuals(self, tissue, energy):
        return tissue.perimeters[0] - self.measured_perimeters


@pytest.mark.parametrize("noise", [pytest.param(1e-1, marks=pytest.mark.thorough), 1e-7])
@pytest.mark.thorough
def test_undetermined_directions_have_the_deviation_of_the_prior(hidden, noise):
    tissue, truth = hidden
    measured = tissue.perimeters[0] + noise * jax.random.normal(jax.random.key(0), (20,))
    problem, fit = fitted(tissue, truth, OneNumber(measured))
    without_prior = vx.uncertainty(problem, fit)
    assert int(jnp.sum(jnp.isinf(without_prior.deviations))) == 7
    assert np.isinf(p0_of(without_prior.deviation)).any()
    # Along undetermined directions the deviation is that of the prior, for any precision of the data.
    prior = 0.3
    with_prior = vx.uncertainty(problem, fit, prior=prior)
    # The data determine one direction, by twenty measurements (Sherman-Morrison formula).
    slope = _slope(problem, fit)
    reduction = np.outer(slope, slope) / (
        slope @ slope + (float(without_prior.noise) / prior) ** 2 / 20
    )
    expected = prior**2 * (np.eye(8) - reduction)
    np.testing.assert_allclose(np.sort(with_prior.deviations)[1:], prior, rtol=1e-9)
    np.testing.assert_allclose(with_prior.covariance, expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(p0_of(with_prior.deviation), np.sqrt(np.diag(expected)), rtol=1e-4)
    best = 1 / np.sqrt(1 / float(without_prior.deviations[-1]) ** 2 + 1 / prior**2)
    assert float(with_prior.deviations[-1]) == pytest.approx(best, rel=1e-6)


def _slope(problem, fit):
    """Gradient of a residual with respect to the target shape factors, by finite differences."""

    @jax.jit
    def residual(p0):
        return problem.residuals(vx.energies.ShapeFactorEnergy(p0), fit.tissue, None)[0][0]

    p0 = p0_of(fit.energy)
    step = 1e-5 * np.eye(len(p0))
    return np.array([float(residual(p0 + e) - residual(p0 - e)) / 2e-5 for e in step])


@pytest.mark.thorough
def test_position_without_influence_on_the_cost_does_not_change_deviations(hidden):
    tissue, truth = hidden
    measured = tissue.perimeters[0] + 0.1 * jax.random.normal(jax.random.key(0), (20,))
    problem, fit = fitted(tissue, truth, OneNumber(measured))
    moving = dataclasses.replace(problem, fit_position=True)
    without_position, with_position = (vx.uncertainty(p, fit, prior=0.3) for p in (problem, moving))
    # With two more parameters the estimate of the noise is a little larger.
    ratio = float(with_position.noise / without_position.noise)
    np.testing.assert_allclose(
        p0_of(with_position.deviation), p0_of(without_position.deviation), rtol=ratio - 1
    )
    assert 1 < ratio < 1.2


@pytest.mark.thorough
def test_exact_data_give_zero_deviation(hidden):
    tissue, truth = hidden
    problem, fit = fitted(tissue, truth, OneNumber(jnp.full(20, 3.6, float)))
    exact = eqx.tree_at(
        lambda p: p.cost.measured_perimeters,
        problem,
        jnp.full(20, problem(fit.energy, fit.tissue)[1].tissue.perimeters[0]),
    )
    estimate = vx.uncertainty(exact, fit, prior=0.3)
    assert float(estimate.deviations[-1]) < 1e-9
    np.testing.assert_allclose(estimate.deviations[:-1], 0.3)


@pytest.mark.slow
def test_fitted_position_increases_the_uncertainty(hidden):
    tissue, truth = hidden
    width = 0.12
    image = np.asarray(render(tissue, (48, 48), width))
    image = image + 0.05 * image.max() * np.random.default_rng(0).normal(size=image.shape)
    cost = MeshImage(image, width)
    fit = vx.fit(
        vx.InverseProblem(tissue, truth, cost, response=FIXED_TOPOLOGY),
        optax.adam(1e-3),
        2,
        progress=False,
    )
    fixed, fitted_position = (
        vx.uncertainty(
            vx.InverseProblem(tissue, truth, cost, response=FIXED_TOPOLOGY, fit_position=moves),
            fit,
        )
        for moves in (False, True)
    )
    assert (p0_of(fitted_position.deviation) > p0_of(fixed.deviation)).all()
    assert float(jnp.max(p0_of(fitted_position.deviation) / p0_of(fixed.deviation))) < 3


@pytest.mark.thorough
def test_uncertainty_does_not_depend_on_spare_slots():
    tissue, truth = relaxed(6, 3)
    noise = 1e-2 * np.random.default_rng(0).normal(size=tissue.vertices.shape)

    def estimate(capacity):
        start = tissue.with_capacity(capacity)
        noisy = tissue.with_vertices(tissue.vertices + noise).with_capacity(capacity)
        energy = vx.energies.ShapeFactorEnergy(jnp.resize(p0_of(truth), capacity))
        return vx.uncertainty(*fitted(start, energy, VertexDistance(noisy)), prior=0.5)

    plain, padded = estimate(6), estimate(9)
    assert float(padded.noise) == pytest.approx(float(plain.noise), rel=1e-6)
    deviation = p0_of(padded.deviation)
    np.testing.assert_allclose(deviation[:6], p0_of(plain.deviation), rtol=1e-5)
    np.testing.assert_allclose(deviation[6:], 0.5)


@pytest.mark.thorough
def test_invalid_arguments_are_rejected(hidden, without_type_checks):
    tissue, truth = hidden
    problem, fit = fitted(tissue, truth, VertexDistance(tissue))
    every: Any = "all"
    with pytest.raises(ValueError, match="`prior` must be positive"):
        vx.uncertainty(problem, fit, prior=0.0)
    with pytest.raises(ValueError, match="`prior` must be positive and finite"):
        vx.uncertainty(problem, fit, prior=float("inf"))
    with pytest.raises(TypeError, match="`n_independent` must be one real number"):
        vx.uncertainty(problem, fit, n_independent=every)
    stack = lambda tree: jax.tree.map(lambda x: jnp.stack([x, x]) if eqx.is_array(x) else x, tree)
    with pytest.raises(ValueError, match="must be single, but are a batch"):
        vx.uncertainty(stack(problem), stack(fit))
    with pytest.raises(ValueError, match="more independent residuals than parameters"):
        vx.uncertainty(problem, fit, n_independent=8)
