"""Equilibria of an external program, a simulator in NumPy and SciPy, compared with vertax."""

import dataclasses
import re
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from external_helpers import Foam
from helpers import central_difference

import vertax as vx
from vertax.external import Edges, SimulatorError
from vertax.external._host import Job, Request, run_jobs

ADAM = optax.adam(3e-3)
FOAM = Foam()


def foam_energy(tensions):
    return vx.energies.AreaElasticity(10.0, 1.0) + vx.energies.LineTension(jnp.asarray(tensions))


@pytest.fixture(scope="module")
def case():
    """A tissue at rest, an energy with other tensions, and the distance to displaced positions."""
    tissue = vx.initialise.periodic_voronoi(6, key=jax.random.key(3), softening=0.0)
    tensions = 0.3 + 0.04 * np.sin(1.7 * np.arange(tissue.n_edges))
    tissue = vx.External(FOAM)(tissue, foam_energy(tensions)).tissue
    displacement = 0.03 * np.cos(np.arange(tissue.vertices.size)).reshape(-1, 2)
    cost = vx.costs.VertexDistance(tissue.with_vertices(tissue.vertices + displacement))
    return tissue, foam_energy(1.02 * tensions), cost


def problem(case, **settings):
    tissue, energy, cost = case
    adjoint = settings.pop("adjoint", vx.EquilibriumPropagation())
    return vx.InverseProblem(
        tissue, energy, cost, response=vx.External(FOAM, **settings), adjoint=adjoint
    )


@pytest.fixture(scope="module")
def implicit(case):
    """The gradient by the implicit function theorem, with a dense pseudo-inverse."""
    tissue, energy, cost = case
    relaxed = vx.External(FOAM)(tissue, energy).tissue
    return _implicit(relaxed, energy.terms[1].tension, cost)


@eqx.filter_jit
def _derivatives(tissue, tensions, cost):
    displaced = lambda x: tissue.with_vertices(x.reshape(-1, 2))
    value = lambda x, tensions: foam_energy(tensions)(displaced(x))
    x = tissue.vertices.ravel()
    cost_gradient = jax.grad(lambda x: cost(displaced(x), foam_energy(tensions)))(x)
    return (
        cost_gradient,
        jax.hessian(value)(x, tensions),
        jax.jacobian(jax.grad(value), 1)(x, tensions),
    )


def _implicit(*args):
    cost_gradient, hessian, mixed = map(np.asarray, _derivatives(*args))
    return -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ cost_gradient


@eqx.filter_jit
def evaluate(problem):
    return problem.value_and_gradient(throw=False)


def gradient_of(problem):
    evaluation = evaluate(problem)
    return np.asarray(evaluation.gradient.terms[1].tension), evaluation


def error(gradient, expected):
    return np.linalg.norm(gradient - expected) / np.linalg.norm(expected)


def test_lengths_and_areas_of_edges(case):
    for tissue in (case[0], vx.initialise.free_voronoi(5, key=jax.random.key(0))):
        straight = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, 0.0)
        edges = Edges.of(straight)
        vertices = np.asarray(straight.vertices)
        lengths = np.hypot(*edges.vectors(vertices).T)
        np.testing.assert_allclose(lengths, straight.edge_lengths, rtol=1e-12)
        np.testing.assert_allclose(edges.areas(vertices), straight.areas, rtol=1e-12)


def test_gradient_equals_implicit_differentiation(case, implicit):
    gradient, evaluation = gradient_of(problem(case))
    assert error(gradient, implicit) < 1e-6
    cosine = gradient @ implicit / np.linalg.norm(gradient) / np.linalg.norm(implicit)
    assert cosine > 1 - 1e-10
    assert evaluation.equilibrium.converged
    assert evaluation.outcome.converged


@pytest.mark.thorough
def test_one_sided_error_is_of_first_order(case, implicit):
    def gradient(beta):
        adjoint = vx.EquilibriumPropagation(jnp.array(beta), centred=False)
        return gradient_of(problem(case, adjoint=adjoint))[0]

    errors = [error(gradient(beta), implicit) for beta in (1e-4, 1e-3)]
    assert errors[1] / errors[0] == pytest.approx(10, rel=0.3)


def test_gradient_by_derivatives_of_the_program(case, implicit):
    gradient, evaluation = gradient_of(problem(case, slope="program", stiffness=10.0))
    assert error(gradient, implicit) < 1e-6
    assert evaluation.equilibrium.energy == pytest.approx(
        float(case[1](evaluation.equilibrium.tissue)), rel=1e-12
    )


def test_gradient_matches_finite_differences(case):
    inverse = problem(case)
    tensions = case[1].terms[1].tension
    gradient, _ = gradient_of(inverse)
    direction = np.cos(np.arange(tensions.size))
    cost = lambda tensions: inverse(foam_energy(tensions))[0]
    slope = central_difference(cost, tensions, direction, step=1e-4)
    assert gradient @ direction == pytest.approx(float(slope), rel=1e-5)


def numpy_request(case, forces=None):
    tissue, energy, _ = jax.tree.map(np.asarray, case)
    return Request(tissue, energy, forces, None)


def test_slope_by_differences_equals_slope_by_program(case):
    request = numpy_request(case)
    jobs = [Job(FOAM, request, slope, 1e-4) for slope in ("program", "differences")]
    (by_program, by_differences), reason = run_jobs(jobs, 2, False, True)
    assert reason is None
    assert by_program is not None
    assert by_differences is not None
    lengths = by_program.slope.terms[1].tension
    np.testing.assert_allclose(by_differences.slope.terms[1].tension, lengths, rtol=1e-8)
    relaxed = case[0].with_vertices(jnp.asarray(by_program.vertices))
    np.testing.assert_allclose(lengths, relaxed.edge_lengths, rtol=1e-12)


@pytest.mark.parametrize(
    ("failure", "message"),
    [
        ("raises", "OSError: the reactor is too hot"),
        ("shape", r"`vertices` as an array of shape \(11, 2\)"),
        ("nan", "`vertices` with NaN"),
        ("text", "must hold real numbers"),
    ],
)
def test_invalid_results_are_simulator_errors(case, failure, message):
    results, reason = run_jobs(
        [Job(Foam(failure=failure), numpy_request(case), "energy", 1e-4)], 1, False, True
    )
    assert results == [None]
    assert isinstance(reason, SimulatorError)
    assert re.search(message, str(reason))


def test_differences_of_a_nan_energy_fail(case):
    job = Job(Foam(failure="nan energy"), numpy_request(case), "differences", 1e-4)
    results, reason = run_jobs([job], 1, False, True)
    assert results == [None]
    assert "The energy by the program is nan" in str(reason)


def test_requests_with_nan_are_not_run(case):
    request = numpy_request(case, forces=np.full_like(case[0].vertices, np.nan))
    results, reason = run_jobs([Job(FOAM, request, "energy", 1e-4)], 1, False, True)
    assert results == [None]
    assert reason is None


@pytest.fixture
def set_failure(monkeypatch):
    """A function that makes the shared simulator fail during a test, without recompilation."""
    return lambda failure: monkeypatch.setattr(FOAM, "failure", failure)


def test_failure_of_the_program_is_reported(case, set_failure):
    tissue, energy, _ = case
    response = vx.External(FOAM)
    set_failure("raises")
    failed = response.ledger.failed
    with pytest.raises(SimulatorError, match="Foam failed: OSError: the reactor is too hot"):
        response(tissue, energy)
    assert response.ledger.failed == failed + 1
    failed_equilibrium = response(tissue, energy, throw=False)
    assert not failed_equilibrium.converged
    assert np.isnan(failed_equilibrium.tissue.vertices).all()
    assert "too hot" in str(response.last_error_message())
    with pytest.raises(Exception, match="the reactor is too hot"):
        eqx.filter_jit(lambda e: response(tissue, e).energy)(energy).block_until_ready()


def test_result_that_is_not_at_rest_raises(case, set_failure):
    tissue, energy, _ = case
    set_failure("not at rest")
    with pytest.raises(RuntimeError, match="not at rest under the energy"):
        vx.External(FOAM)(tissue, energy)


@pytest.mark.thorough
def test_failure_of_a_nudged_run_makes_the_gradient_unreliable(case, set_failure):
    set_failure("when nudged")
    lenient = problem(case, adjoint=vx.EquilibriumPropagation(throw=False))
    evaluation = evaluate(lenient)
    assert evaluation.equilibrium.converged
    assert not evaluation.outcome.converged


@pytest.mark.thorough
def test_fit_continues_from_a_checkpoint(case, tmp_path, set_failure):
    tissue, energy, _ = case
    target = vx.External(FOAM)(tissue, foam_energy(energy.terms[1].tension[::-1])).tissue
    inverse = problem((tissue, energy, vx.costs.VertexDistance(target)))
    uninterrupted = vx.fit(inverse, ADAM, 4, progress=False)
    assert uninterrupted.history.cost[-1] < uninterrupted.history.cost[0]
    vx.fit(inverse, ADAM, 2, progress=False, checkpoint=tmp_path / "fit.npz")
    continued = vx.fit(inverse, ADAM, 4, progress=False, checkpoint=tmp_path / "fit.npz")
    np.testing.assert_array_equal(continued.history.cost, uninterrupted.history.cost)
    set_failure("raises")
    with pytest.raises(vx.FitError, match="Foam failed: OSError: the reactor is too hot"):
        vx.fit(inverse, ADAM, 4, progress=False)


@pytest.mark.thorough
def test_members_of_a_batch_fail_independently(case):
    tissue, energy, _ = case
    tensions = energy.terms[1].tension
    batch = jnp.stack([tensions, tensions.at[0].set(-1.0), 1.1 * tensions])
    response = vx.External(FOAM, workers=3)
    relax = lambda tensions: response(tissue, foam_energy(tensions), throw=False)
    runs = response.ledger.runs
    equilibria = eqx.filter_vmap(relax)(batch)
    assert response.ledger.runs == runs + 3
    np.testing.assert_array_equal(equilibria.converged, [True, False, True])
    alone = vx.External(FOAM)(tissue, foam_energy(batch[2])).tissue
    np.testing.assert_allclose(equilibria.tissue.vertices[2], alone.vertices, atol=1e-12)


@pytest.mark.slow
def test_processes_and_threads_agree(case):
    jobs = [Job(FOAM, numpy_request(case), "program", 1e-4)] * 2
    by_threads, _ = run_jobs(jobs, 2, False, True)
    by_processes, reason = run_jobs(jobs, 2, True, True)
    assert reason is None
    for a, b in zip(jax.tree.leaves(by_threads), jax.tree.leaves(by_processes), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_processes_time_out_and_die_independently(case):
    tissue, energy, _ = numpy_request(case)[:3]
    first_tensions = [0.05, 0.15, 0.3, 0.3]
    energies = [
        eqx.tree_at(lambda e: e.terms[1].tension, energy, energy.terms[1].tension.copy())
        for _ in first_tensions
    ]
    for number, value in enumerate(first_tensions):
        energies[number].terms[1].tension[0] = value
    jobs = [
        Job(Foam(failure="by tension"), Request(tissue, e, None, None), "energy", 1e-4)
        for e in energies
    ]
    began = time.perf_counter()
    results, _ = run_jobs(jobs, 4, True, True, 60.0)
    assert [answer is None for answer in results] == [True, True, False, False]
    assert time.perf_counter() - began < 300
    for job, message in zip(jobs, ("ran the program died", "not done after 2 s"), strict=False):
        assert message in str(run_jobs([job], 1, True, True, 2.0)[1])
    # A TimeoutError of the simulator is not that of the process, which continues.
    times_out = Job(Foam(failure="times out"), numpy_request(case), "energy", 1e-4)
    _, reason = run_jobs([times_out], 1, True, True, 60.0)
    assert "TimeoutError: the reactor does not answer" in str(reason)
    # The next job gets a new process.
    (last_result,), _ = run_jobs(jobs[2:3], 1, True, True, 60.0)
    assert last_result is not None


@pytest.mark.slow
def test_fit_in_processes(case):
    tissue, energy, cost = case
    response = vx.External(Foam(), workers=2, processes=True, timeout=120.0)
    adjoint = vx.EquilibriumPropagation()
    inverse = vx.InverseProblem(tissue, energy, cost, response=response, adjoint=adjoint)
    in_threads = problem(case)
    fits = [vx.fit(p, ADAM, 2, progress=False) for p in (inverse, in_threads)]
    np.testing.assert_allclose(fits[0].history.cost, fits[1].history.cost, rtol=1e-12)
    hanging = dataclasses.replace(
        inverse, response=vx.External(Foam(failure="hangs"), processes=True, timeout=1.0)
    )
    with pytest.raises(vx.FitError, match="not done after 1 s"):
        vx.fit(hanging, ADAM, 2, progress=False)


@pytest.mark.slow
def test_gradient_in_single_precision(case, implicit):
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, case)
    gradient, evaluation = gradient_of(problem(single))
    assert gradient.dtype == np.float32
    assert evaluation.equilibrium.converged
    assert error(gradient, implicit) < 1e-2


@pytest.mark.parametrize(
    ("adjoint", "message"),
    [
        (
            vx.ImplicitDifferentiation(),
            "ImplicitDifferentiation needs derivatives of the relaxation",
        ),
        (vx.adjoints.AutomaticDifferentiation(), "AutomaticDifferentiation needs derivatives"),
        (vx.EquilibriumPropagation(nudge="cost"), "which an external program cannot do"),
    ],
)
def test_other_adjoints_raise(case, adjoint, message):
    with pytest.raises(ValueError, match=message):
        problem(case, adjoint=adjoint)
    with pytest.raises(ValueError, match=message):
        vx.External(FOAM)(case[0], case[1], adjoint=adjoint)


def test_guidance_raises(case):
    with pytest.raises(ValueError, match="`guidance` adds the cost to the relaxed energy"):
        dataclasses.replace(problem(case), guidance=1.0)


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        ({"simulator": 1}, TypeError, "simulator"),
        ({"slope": "guess"}, (ValueError, TypeError), "slope"),
        ({"slope": "program"}, ValueError, "`stiffness` is missing"),
        ({"tolerance": 0.0}, ValueError, "`tolerance` must be positive"),
        ({"workers": 0}, ValueError, "`workers` must be at least 1"),
        ({"simulator": Foam}, TypeError, "simulator"),
        ({"timeout": 0.0, "processes": True}, ValueError, "`timeout` must be positive"),
        ({"timeout": 5.0}, ValueError, "`timeout` needs processes=True"),
    ],
)
def test_settings_are_checked(settings, kind, message):
    with pytest.raises(kind, match=message):
        vx.External(**({"simulator": FOAM} | settings))


def test_torques_require_support_by_the_simulator(case):
    tissue, energy, _ = numpy_request(case)[:3]
    torques = np.ones(len(energy.terms[1].tension))
    job = Job(FOAM, Request(tissue, energy, 0 * tissue.vertices, torques), "energy", 1e-4)
    _, reason = run_jobs([job], 1, False, True)
    assert "this simulator does not support torques on them" in str(reason)


def test_missing_methods_are_named(case):
    class SimulatorWithoutGradient(vx.external.AbstractSimulator):
        def relax(self, tissue, energy, forces):
            return np.asarray(tissue.vertices)

    for slope, message in (
        ("program", "has no `parameter_gradient`"),
        ("differences", "no `energy`"),
    ):
        _, reason = run_jobs(
            [Job(SimulatorWithoutGradient(), numpy_request(case), slope, 1e-4)], 1, False, True
        )
        assert message in str(reason)
