"""Parameters of an energy from the motion in a movie with neighbour changes."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from movie_helpers import rows_of, table_of

import vertax as vx
from vertax.energies import AreaElasticity, by_type
from vertax.inference import Movie, fit_movie, movie_from_table
from vertax.inference._movie_equations import moved_nodes
from vertax.inference._tracking_noise import tracking_noise

pytestmark = pytest.mark.thorough

TYPES = np.arange(16) % 2
TABLE = jnp.array([[0.6, 0.3], [0.3, 0.5]])
TRUTH = AreaElasticity(1.0, 1.0) + by_type(TABLE, TYPES)
GUESS = AreaElasticity(1.0, 1.0) + by_type(0.2 * jnp.ones((2, 2)), TYPES)
FRICTION = 0.7


@pytest.fixture(scope="module")
def evolved():
    """A movie with frames that are the steps of the implicit Euler method, with T1 transitions."""
    tissue = vx.initialise.periodic_voronoi(16, key=jax.random.key(0))
    times = jnp.linspace(0, 6, 41)
    return vx.evolve(tissue, TRUTH, vx.dissipations.SubstrateFriction(FRICTION), times)


@pytest.fixture(scope="module")
def movie(evolved):
    return Movie(list(evolved.trajectory), evolved.times)


def noisy(evolved, noise, seed, every=1):
    rng = np.random.default_rng(seed)
    moved = lambda t: t.with_vertices(t.vertices + noise * rng.normal(size=t.vertices.shape))
    frames = list(evolved.trajectory)[::every]
    return Movie([moved(t) for t in frames], evolved.times[::every])


def test_parameters_of_an_exact_movie_are_recovered_across_transitions(movie):
    assert any(event.kind == "T1" for event in movie.events)
    fit = fit_movie(movie, GUESS, friction=FRICTION)
    assert fit.converged
    np.testing.assert_allclose(fit.energy.terms[1].table, TABLE, rtol=1e-5)
    assert fit.misfit < 1e-6
    assert fit.friction_deviation == 0


def test_tracking_noise_is_estimated(evolved, movie):
    assert float(tracking_noise(movie.tissue, movie.times)) < 2e-3
    for seed, noise in enumerate((0.003, 0.01)):
        tracked = noisy(evolved, noise, seed)
        assert float(tracking_noise(tracked.tissue, tracked.times)) == pytest.approx(noise, rel=0.1)
    # Unequal intervals, or fewer than six frames.
    times = jnp.cumsum(1.0 + 0.5 * (jnp.arange(movie.n_frames) % 2))
    assert float(tracking_noise(movie.tissue, times)) == 0
    few = jax.tree.map(lambda x: x[:5] if eqx.is_array(x) else x, movie.tissue)
    assert float(tracking_noise(few, movie.times[:5])) == 0


def test_frames_that_are_far_apart_are_named(evolved):
    coarse = Movie(list(evolved.trajectory)[:16:2], evolved.times[:16:2])
    with pytest.warns(UserWarning, match="Frames are too far apart: .* 4.7 standard errors"):
        fit = fit_movie(coarse, GUESS, friction=FRICTION, noise=0.0)
    error = np.abs(fit.energy.terms[1].tension - TABLE[jnp.triu_indices(2)])
    change = np.abs(fit.interval_error.terms[1].tension)
    assert np.all(error < change)
    assert np.all(error > 0.3 * change)


def test_friction_is_fitted_with_a_known_stiffness(movie):
    fit = fit_movie(movie, GUESS, friction=1.5, fit_friction=True)
    assert float(fit.friction) == pytest.approx(FRICTION, rel=1e-4)
    np.testing.assert_allclose(fit.energy.terms[1].table, TABLE, rtol=1e-4)


FREE = AreaElasticity(jnp.array(0.8), 1.0) + by_type(0.2 * jnp.ones((2, 2)), TYPES)


@pytest.mark.parametrize("every", [1, 5])
def test_the_scale_of_forces_is_undetermined_without_a_constant(evolved, every):
    tracked = noisy(evolved, 0.005, 0, every)
    tensions = [f"terms[1].tension[{k}]" for k in range(3)]
    with pytest.warns(UserWarning, match=r"does not determine terms\[0\].*\+friction \("):
        fit = fit_movie(tracked, FREE, friction=FRICTION, fit_friction=True, noise=0.005)
    assert fit.undetermined == ("+".join(["terms[0].stiffness", *tensions, "friction"]),)
    assert np.isinf(fit.friction_deviation)
    assert np.isinf(fit.deviation.terms[0].stiffness)
    assert np.isinf(fit.deviation.terms[1].tension).all()
    np.testing.assert_array_equal(np.isinf(fit.covariance), np.eye(5, dtype=bool))


@pytest.mark.filterwarnings("ignore:Frames are too far apart")
def test_parameters_that_frames_far_apart_hardly_determine_are_named(evolved):
    tracked = noisy(evolved, 0.005, 0, 5)
    with pytest.warns(UserWarning, match=r"hardly determines .* terms\[0\]\.stiffness\+terms"):
        fit = fit_movie(tracked, FREE, friction=FRICTION, noise=0.005)
    assert fit.undetermined == ()
    assert 0.2 < float(fit.deviation.terms[0].stiffness) < 3
    fit = fit_movie(noisy(evolved, 0.005, 0), FREE, friction=FRICTION, noise=0.005)
    assert float(fit.deviation.terms[0].stiffness) < 0.1


# (The frames are exact steps of the implicit Euler method.)
@pytest.mark.filterwarnings("ignore:Frames are too far apart")
def test_parameters_scale_with_the_friction(movie):
    energy = AreaElasticity(jnp.array(0.8), 1.0) + by_type(0.2 * jnp.ones((2, 2)), TYPES)
    fit = fit_movie(movie, energy, friction=3 * FRICTION)
    np.testing.assert_allclose(fit.energy.terms[1].table, 3 * TABLE, rtol=1e-4)
    assert float(fit.energy.terms[0].stiffness) == pytest.approx(3, rel=1e-4)


def test_each_cell_and_each_pair_of_cells_may_have_parameters(movie):
    energy = AreaElasticity(jnp.ones(16), 1.0) + by_type(0.4 * jnp.ones((16, 16)), jnp.arange(16))
    with (
        pytest.warns(UserWarning, match=r"does not determine terms\[1\]\.tension\[\d+\], .* more"),
        pytest.warns(UserWarning, match="Standard errors are NaN: .* more steps than parameters"),
    ):
        fit = fit_movie(movie, energy, friction=FRICTION, noise=0.0)
    pair = np.asarray(fit.energy.terms[1].table)
    first, second = np.asarray(movie.frame(20).topology.edge_cells).T
    expected = np.asarray(TABLE)[TYPES[first], TYPES[second]]
    np.testing.assert_allclose(pair[first, second], expected, rtol=1e-3)
    np.testing.assert_allclose(fit.energy.terms[0].stiffness, 1, rtol=1e-3)
    # Cells that never meet keep the guess, and their tension is not determined.
    contacts = np.concatenate([np.asarray(movie.frame(k).topology.edge_cells) for k in range(41)])
    apart = np.ones((16, 16), bool)
    apart[contacts[:, 0], contacts[:, 1]] = apart[contacts[:, 1], contacts[:, 0]] = False
    np.testing.assert_allclose(pair[apart], 0.4)
    infinite = np.isinf(fit.deviation.terms[1].tension)
    assert infinite[apart[jnp.triu_indices(16)]].all()
    assert len(fit.undetermined) == infinite.sum() < 90


def test_errors_by_tracking_noise_are_covered(evolved):
    errors, deviations = [], []
    for seed in range(6):
        fit = fit_movie(noisy(evolved, 0.005, seed), GUESS, friction=FRICTION, noise=0.005)
        errors.append(fit.energy.terms[1].tension - TABLE[jnp.triu_indices(2)])
        deviations.append(fit.deviation.terms[1].tension)
    ratio = np.abs(np.array(errors) / np.array(deviations))
    assert np.mean(ratio < 1) > 0.4
    assert np.mean(ratio < 2) > 0.8
    assert np.max(np.abs(errors)) < 0.03
    # With short edges the fit is biased by more than its standard error.
    short = noisy(evolved, 0.005, 0)
    biased = fit_movie(short, GUESS, friction=FRICTION, noise=0.005, min_edge_length=0.0)
    bias = biased.energy.terms[1].tension - TABLE[jnp.triu_indices(2)]
    assert np.abs(np.mean(bias)) > 3 * np.abs(np.mean(errors))


def test_errors_of_a_chain_on_the_outline_are_small_and_covered(monkeypatch):
    """A movie of another integrator, in which the nodes of the outline have friction."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import movie_coverage as benchmark  # pyright: ignore[reportMissingImports]

    movie = movie_from_table(benchmark.chains(0))
    assert movie.outline_nodes is not None
    assert set(movie.outline_nodes.ravel()) == {0, benchmark.PIECES - 1}
    guess = benchmark.energy_of(np.full((2, 2), 0.2), jnp.array(0.15))
    true = np.append(benchmark.TABLE[np.triu_indices(2)], benchmark.OUTLINE)
    errors, deviations = {}, {}
    for nodes in (False, True):
        fit = fit_movie(movie, guess, friction=benchmark.FRICTION, noise=0.0, node_friction=nodes)
        of = lambda energy: np.append(energy.terms[1].tension, energy.terms[1].outline)
        errors[nodes], deviations[nodes] = np.abs(of(fit.energy) - true), of(fit.deviation)
    assert errors[True].max() < 0.02
    assert errors[False].max() > 1.5 * errors[True].max()
    assert (errors[True] < 2.5 * deviations[True]).all()


def test_displacements_of_nodes_do_the_work_of_the_nodes():
    """For any motion at fixed angles, the sum over vertices is that over nodes on circles."""
    before = cluster(6, 0)
    n, rng = 3, np.random.default_rng(0)
    after = before.with_vertices(before.vertices + 0.01 * rng.normal(size=before.vertices.shape))
    m = after.topology
    outline = np.flatnonzero(m.on_outline)
    nodes = jnp.zeros(after.n_edges, int).at[outline].set(n)
    lines = lambda x: vx.mesh.Drawing(after.with_vertices(x), n + 1).lines[m.half_edge][outline]
    number, present = jnp.arange(after.n_vertices), jnp.ones(after.n_vertices, bool)
    moved = moved_nodes(before, after, number, present, nodes, n)
    displaced = (lines(after.vertices) - lines(before.vertices))[:, 1 : n + 1]
    for seed in range(3):
        motion = 1e-4 * np.random.default_rng(seed).normal(size=after.vertices.shape)
        work = np.sum(
            displaced * (lines(after.vertices + motion) - lines(after.vertices))[:, 1 : n + 1]
        )
        assert float(jnp.sum(moved * motion)) == pytest.approx(work, rel=1e-6)
    # A translation moves all nodes alike.
    shifted = before.with_vertices(before.vertices + jnp.array([0.1, 0.2]))
    total = moved_nodes(before, shifted, number, present, nodes, n).sum(axis=0)
    np.testing.assert_allclose(total, n * len(outline) * np.array([0.1, 0.2]))


@pytest.mark.filterwarnings("ignore:Frames are too far apart")
def test_windows_are_fitted_in_parallel(movie):
    fit = fit_movie(movie, GUESS, friction=FRICTION, windows=3)
    assert fit.energy.terms[1].tension.shape == (3, 3)
    np.testing.assert_allclose(
        fit.energy.terms[1].tension, [TABLE[jnp.triu_indices(2)]] * 3, rtol=1e-4
    )
    assert fit.num_equations.sum() == fit_movie(movie, GUESS, friction=FRICTION).num_equations


def test_wrong_arguments_are_named(movie, evolved):
    with pytest.raises(ValueError, match="`implicitness` must"):
        fit_movie(movie, GUESS, implicitness=0.3)
    with pytest.raises(ValueError, match="`windows` must be at most the number of steps, 39"):
        fit_movie(movie, GUESS, windows=40)
    with pytest.raises(ValueError, match="`energy` must have arrays"):
        fit_movie(movie, AreaElasticity(1.0, 1.0))
    with pytest.raises(ValueError, match="`node_friction` must be False for a movie without nodes"):
        fit_movie(movie, GUESS, node_friction=True)
    short = Movie(list(evolved.trajectory)[:2], evolved.times[:2])
    with pytest.raises(ValueError, match="three frames or more"):
        fit_movie(short, GUESS)


def test_corners_without_the_bulges_of_the_outline_are_named():
    types = np.arange(24) % 2
    tension = by_type([[0.28, 0.24], [0.24, 0.26]], types, outline=jnp.array(0.25))
    energy = AreaElasticity(1.0, 1.2) + tension
    relax = vx.Relaxation(tolerance=1e-11, contact_range=None)
    at_rest = relax(cluster(24, 3, lloyd_steps=3), energy).tissue
    guess = AreaElasticity(1.0, 1.2) + by_type(
        0.1 * jnp.ones((2, 2)), types, outline=jnp.array(0.1)
    )

    def movie(points):
        rows = [row for k in range(8) for row in rows_of(at_rest, k, points=points)]
        return movie_from_table(table_of(rows))

    with pytest.warns(UserWarning, match="outline are straight"):
        wrong = fit_movie(movie(1), guess).energy.terms[1]
    assert np.max(np.abs(wrong.tension - tension.tension)) > 0.015
    with pytest.warns(UserWarning, match=r"does not determine terms\[1\]\.outline \(`und.* known"):
        fit = fit_movie(movie(1), guess, outline=False)
    inner, deviation = fit.energy.terms[1], fit.deviation.terms[1]
    np.testing.assert_allclose(inner.tension, tension.tension, rtol=1e-3)
    assert fit.undetermined == ("terms[1].outline",)
    assert np.isinf(deviation.outline)
    assert np.isfinite(deviation.tension).all()
    fit = fit_movie(movie(200), guess).energy.terms[1]
    np.testing.assert_allclose(fit.tension, tension.tension, rtol=1e-3)
    assert float(fit.outline) == pytest.approx(0.25, rel=1e-3)
