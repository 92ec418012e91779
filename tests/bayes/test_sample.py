"""The Laplace approximation, and draws from a posterior."""

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("blackjax", reason='needs the extra: pip install -e ".[bayes]"')

import equinox as eqx
import numpyro.distributions as dist
from bayes_helpers import MEAN, N_CELLS, PRIOR, SPREAD, noisy_problem, padded

import vertax as vx
from vertax import bayes

NAME = "target_shape_factor"


def draw(density, draws=20, **options):
    options = {"warmup": 60, "chains": 2, "progress": False} | options
    return bayes.sample(density, 0, draws=draws, **options)


@pytest.fixture(scope="module")
def linear():
    """A problem with so little noise that its equilibrium is a linear function of the parameters."""
    return noisy_problem(1e-3)[0]


class Limited(eqx.Module):
    """Target shape factors; no equilibrium if that of the first cell is above a limit."""

    limit: jax.Array

    def __call__(self, parameters):
        p0 = parameters[NAME]
        return vx.energies.ShapeFactorEnergy(jnp.where(p0[0] < self.limit, p0, jnp.nan))


def density_of(problem, noise: float | None = 1e-3, limit=np.inf):
    """A density; all share their compiled functions."""
    prior = {NAME: PRIOR[NAME].expand([N_CELLS])}
    return bayes.LogPosterior(problem, prior, noise, energy=Limited(jnp.array(limit)))


@pytest.fixture(scope="module")
def closed_form(linear):
    """Mean and covariance of the posterior of a linear model with Gaussian prior and noise."""
    residuals = jax.jit(
        lambda p: linear.residuals(vx.energies.ShapeFactorEnergy(p), linear.tissue, None)[0]
    )
    mean, precision = np.full(N_CELLS, MEAN), np.eye(N_CELLS)
    for _ in range(5):  # Gauss-Newton steps to the mode
        jacobian = np.stack(
            [(residuals(mean + e) - residuals(mean - e)) / 2e-5 for e in 1e-5 * np.eye(N_CELLS)], 1
        )
        precision = jacobian.T @ jacobian / 1e-3**2 + np.eye(N_CELLS) / SPREAD**2
        slope = jacobian.T @ residuals(mean) / 1e-3**2 + (mean - MEAN) / SPREAD**2
        mean = mean - np.linalg.solve(precision, slope)
    return mean, np.linalg.inv(precision)


@pytest.mark.thorough
def test_laplace_approximation_matches_the_closed_form(linear, closed_form):
    laplace = bayes.Laplace(density_of(linear))
    mean, covariance = closed_form
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(laplace.mode, mean, atol=1e-3 * deviation.min())
    ours = laplace.factor @ laplace.factor.T
    np.testing.assert_allclose(ours, covariance, atol=0.02 * covariance.max())


@pytest.mark.thorough
def test_draws_match_the_closed_form(linear, closed_form):
    posterior = draw(density_of(linear), 200)
    mean, covariance = closed_form
    deviation, table = np.sqrt(np.diag(covariance)), posterior.table()
    assert (table["ess"] > 150).all()
    assert (table["r_hat"] < 1.05).all()
    scores = (table["mean"] - mean) / deviation * np.sqrt(table["ess"])
    assert (np.abs(scores) < 4).all()
    np.testing.assert_allclose(table["deviation"], deviation, rtol=4 / np.sqrt(2 * 150))
    np.testing.assert_allclose(table["laplace_deviation"], deviation, rtol=0.1)
    assert posterior.num_gradients > 400


@pytest.mark.thorough  # each adjoint compiles the sampler
@pytest.mark.parametrize(
    "adjoint",
    [vx.ImplicitDifferentiation("sensitivity"), vx.EquilibriumPropagation()],
    ids=["sensitivity", "propagation"],
)
def test_adjoints_give_the_same_chain(linear, adjoint):
    first = draw(density_of(linear))
    other = draw(density_of(dataclasses.replace(linear, adjoint=adjoint)))
    deviation = first.draws(NAME).std()
    np.testing.assert_allclose(first.draws(NAME), other.draws(NAME), atol=1e-3 * deviation)


@pytest.mark.thorough
def test_interrupted_run_continues_bit_for_bit(linear, tmp_path):
    density = density_of(linear)
    complete = draw(density, 40)
    half = draw(density, 20, checkpoint=tmp_path / "chains.npz")
    continued = draw(density, 40, checkpoint=tmp_path / "chains.npz")
    np.testing.assert_array_equal(half.draws(NAME), complete.draws(NAME)[:, :20])
    np.testing.assert_array_equal(continued.draws(NAME), complete.draws(NAME))
    assert continued.num_gradients == complete.num_gradients
    other = density_of(linear, 2e-3)
    with pytest.raises(ValueError, match=r"another density \(numbers in its arrays\)"):
        draw(other, 40, checkpoint=tmp_path / "chains.npz")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::UserWarning")  # one draw is not enough
def test_checkpoint_of_a_density_with_another_function_is_rejected(linear, tmp_path):
    def run(factor):
        density = bayes.LogPosterior(linear, {NAME: PRIOR[NAME]}, lambda p: factor * 1e-3)
        draw(density, 1, warmup=20, chains=1, checkpoint=tmp_path / "chains.npz")

    run(1.0)
    with pytest.raises(ValueError, match=r"another density \(what its functions compute"):
        run(2.0)


@pytest.mark.thorough
def test_proposals_without_equilibrium_are_rejected_and_counted(linear):
    density = density_of(linear, 0.2, MEAN + 0.5 * SPREAD)
    start = {NAME: jnp.full(N_CELLS, MEAN)}
    with pytest.warns(
        UserWarning, match="trajectories met a tissue that did not reach equilibrium"
    ):
        posterior = draw(density, start=start)
    rejected = np.asarray(posterior.data["sample_stats"]["rejected"])
    assert 0 < rejected.sum() < rejected.size
    assert (posterior.draws(NAME)[..., 0] < MEAN + 0.5 * SPREAD).all()
    assert posterior.draws(NAME).std() > 0.05
    with pytest.raises(ValueError, match="`start` must have a finite log density"):
        bayes.Laplace(density, {NAME: jnp.full(N_CELLS, MEAN + SPREAD)})


class Constant(vx.costs.AbstractLeastSquaresCost):
    def residuals(self, tissue, energy):
        return jnp.ones(5)


@pytest.mark.thorough
def test_data_that_determine_nothing_are_rejected(linear):
    density = bayes.LogPosterior(dataclasses.replace(linear, cost=Constant()), PRIOR, 1.0)
    with pytest.raises(ValueError, match="The data determine no parameter"):
        bayes.Laplace(density)


@pytest.mark.thorough
def test_short_edges_cause_a_warning(linear):
    from vertax.bayes._posterior import Posterior

    laplace = bayes.Laplace(density_of(linear))
    stats = {
        "z": np.broadcast_to(laplace.mode, (1, 4, N_CELLS)),
        "shortest_edge": np.array([[0.5, 0.001, 0.3, 0.2]]),
        "num_t1": np.zeros((1, 4), int),
        "n_steps": np.ones((1, 4), int),
        "rejected": np.zeros((1, 4), bool),
        "diverging": np.zeros((1, 4), bool),
    }
    with pytest.warns(UserWarning, match="1 of 4 draws have an edge shorter than 0.02"):
        Posterior.of(laplace, stats, 0)
    stats |= {"num_t1": np.array([[0, 1, 2, 0]])}
    with pytest.warns(UserWarning, match="2 of 4 draws differ .* by T1 transitions"):
        Posterior.of(laplace, stats, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet = {"shortest_edge": np.ones((1, 4)), "num_t1": np.zeros((1, 4), int)}
        Posterior.of(laplace, stats | quiet, 0)


def test_invalid_arguments_are_rejected(linear, without_type_checks):
    density = density_of(linear)
    with pytest.raises(TypeError, match=r"`log_posterior` must be a vertax\.bayes\.LogPosterior"):
        bayes.sample(linear, 0)
    for name, least in (("draws", 1), ("warmup", 20), ("chains", 1)):
        with pytest.raises(ValueError, match=f"`{name}` must be at least {least}"):
            draw(density, **{name: 0})
    laplace = bayes.Laplace(density_of(linear, None))
    with pytest.raises(ValueError, match="`noise` of the LogPosterior must not be None"):
        bayes.Posterior(laplace, None, 0).loo()


@pytest.mark.slow
def test_hyperparameters_of_replicates_of_different_sizes_are_recovered():
    mean, spread, size, sizes = 3.62, 0.05, 8, (6, 8, 6, 8, 6)
    noise, keys = 0.002, jax.random.split(jax.random.key(3), 5)
    z = [jax.random.normal(key, (n,)) for key, n in zip(keys, sizes, strict=True)]
    replicates = [
        padded(noisy_problem(noise, seed, n, truth=mean + spread * z[seed])[0], size)
        for seed, n in enumerate(sizes)
    ]
    hierarchy = {
        "mean": dist.Normal(MEAN, SPREAD),
        "spread": dist.HalfNormal(SPREAD),
        "z": dist.Normal(0.0, 1.0).expand([len(sizes), size]),
    }
    energy = lambda p: vx.energies.ShapeFactorEnergy(p["mean"] + p["spread"] * p["z"])
    density = bayes.LogPosterior(vx.fitting.stack(replicates), hierarchy, noise, energy=energy)
    posterior = bayes.sample(density, 0, draws=300, warmup=200, chains=2, progress=False)
    assert not posterior.data["sample_stats"]["diverging"].values.any()
    # The data are of the 34 cells that were drawn: compare with their mean and spread.
    drawn = mean + spread * np.concatenate(z)
    for name, true in (("mean", drawn.mean()), ("spread", drawn.std())):
        draws = posterior.draws(name).ravel()
        assert abs(draws.mean() - true) < 2 * draws.std(), name
        # 34 cells: standard errors 0.05 / sqrt(34) and 0.05 / sqrt(68), and more by noise.
        assert 0.005 < draws.std() < 0.015, name
    table = posterior.table()
    assert (table["r_hat"] < 1.05).all()


@pytest.mark.thorough
def test_the_adaptation_is_that_of_blackjax():
    import blackjax

    from vertax.bayes import _sample

    deviations = jnp.array([0.5, 1.0, 3.0])
    density = lambda u: -0.5 * jnp.sum((u / deviations) ** 2)
    key, first, steps = jax.random.key(0), jnp.ones(3), 100
    adapt: Any = blackjax.window_adaptation(blackjax.nuts, density, initial_step_size=0.5).run
    (_, tuned), _ = adapt(key, first, steps)
    kernel = blackjax.nuts.build_kernel()
    adaptation = jax.tree.map(jnp.asarray, (_sample._STEP_SIZE[0](0.5), _sample._SCALES[0](3)))

    def step(chain, now):
        step_size = jnp.exp(chain.step_size.log_step_size)
        scales = chain.scales.inverse_mass_matrix
        state, info = kernel(now[0], chain.state, density, step_size, scales)
        moved = _sample._Chain(state, chain.step_size, chain.scales)
        return _sample._adapted(moved, now[1], info.acceptance_rate), None

    start = _sample._Chain(blackjax.nuts.init(first, density), *adaptation)
    stages = _sample._stages(steps, steps + 20)
    assert (stages[steps:] == _sample._DRAW).all()
    chain, _ = jax.lax.scan(step, start, (jax.random.split(key, steps), stages[:steps]))
    np.testing.assert_allclose(
        jnp.exp(chain.step_size.log_step_size_avg), tuned["step_size"], rtol=1e-6
    )
    np.testing.assert_allclose(
        chain.scales.inverse_mass_matrix, tuned["inverse_mass_matrix"], rtol=1e-6
    )
    assert chain.scales.inverse_mass_matrix[2] > 4 * chain.scales.inverse_mass_matrix[1]
    same = _sample._adapted(chain, stages[-1], jnp.asarray(0.1))
    jax.tree.map(np.testing.assert_array_equal, same, chain)


@pytest.mark.thorough  # it compiles the sampler again
def test_the_sampler_compiles_once(linear):
    programs = []

    def listener(event: str, duration_secs: float, **data: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            programs.append(str(data.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listener)

    class Another(Limited):
        """A new class, so that nothing is compiled."""

    prior = {NAME: PRIOR[NAME].expand([N_CELLS])}
    draw(bayes.LogPosterior(linear, prior, 1e-3, energy=Another(jnp.array(np.inf))), 40)
    for function in ("_advance", "evaluate"):
        assert sum(function in program for program in programs) == 1
