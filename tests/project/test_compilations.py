"""Each function compiles once for its shapes and dtypes."""

import contextlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import stack

N = 5
EVENT = "/jax/core/compile/backend_compile_duration"
_events: list[str] = []
_programs: list[str] = []


def _listen(event: str, duration_secs: float, **data: str | int) -> None:
    _events.append(event)
    if event == EVENT:
        _programs.append(str(data.get("fun_name")))


jax.monitoring.register_event_duration_secs_listener(_listen)


class Count:
    """Number of programs that were compiled, or read from the compilation cache."""

    n = 0


@contextlib.contextmanager
def compilations():
    count, before = Count(), _events.count(EVENT)
    yield count
    count.n = _events.count(EVENT) - before


@pytest.fixture(scope="module", autouse=True)
def _fresh():
    jax.clear_caches()
    eqx.clear_caches()


def problem(**options):
    tissue = random_tissue(N, 0)
    # Weakly typed, as in code of users.
    return vx.InverseProblem(
        tissue, ShapeFactorEnergy(jnp.full(N, 3.7)), vx.costs.VertexDistance(tissue), **options
    )


def evolve():
    times = jnp.linspace(0, 1, 3)
    friction = vx.dissipations.SubstrateFriction(1.0)
    return vx.evolve(random_tissue(N, 0), ShapeFactorEnergy(3.7), friction, times)


def soft(cells):
    return vx.energies.AreaElasticity(1.0, cells.target_area)


def grow():
    cycle = vx.growth.GrowAndDivide(growth_rate=0.1, division_area=1.5)
    tissue = random_tissue(N, 0).with_capacity(8)
    return vx.growth.grow(tissue, soft, cycle, jnp.linspace(0, 2, 3), key=1, throw=False)


def bricks():
    """A mask of nine cells in three shifted rows."""
    rows = [[3 * r + 1, 3 * r + 2, 3 * r + 3, 0] for r in range(3)]
    shifted = [np.roll(np.repeat(row, 20), 10 * (r % 2)) for r, row in enumerate(rows)]
    return np.pad(np.repeat(np.array(shifted), 20, axis=0), 6)


OPTIMISER = optax.adam(1e-2)
SOLVER = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
BATCH = lambda: stack([problem(), problem()])
FIT = lambda p, optimiser, **options: vx.fit(p, optimiser, 2, progress=False, **options)
CALLS = {
    "value_and_gradient": lambda: problem().value_and_gradient(),
    "fit": lambda: FIT(problem(), OPTIMISER),
    "fit of a batch": lambda: FIT(BATCH(), OPTIMISER, batched=True),
    "fit by least squares": lambda: FIT(problem(), SOLVER),
    "fit of a batch by least squares": lambda: FIT(BATCH(), SOLVER, batched=True),
    "evolve": evolve,
    "grow": grow,
    "uncertainty": lambda: vx.uncertainty(problem(), FIT(problem(), OPTIMISER)),
    "infer_tensions": lambda: vx.tensions.infer_tensions(bricks()),
}


# These compile for 15 seconds each.
LONG = (
    "fit of a batch",
    "fit by least squares",
    "fit of a batch by least squares",
    "evolve",
    "grow",
    "uncertainty",
)
MARKS = {name: [pytest.mark.thorough] for name in LONG}


@pytest.mark.parametrize(
    "call", [pytest.param(call, id=n, marks=MARKS.get(n, [])) for n, call in CALLS.items()]
)
def test_a_second_call_compiles_nothing(call):
    call()
    with compilations() as second:
        call()
    assert second.n == 0


@pytest.mark.thorough
def test_relaxation_preserves_shapes_and_dtypes():
    kind = lambda x: (jnp.shape(x), jnp.result_type(x), jax.typeof(x).weak_type)
    starts = [random_tissue(N, 1), vx.initialise.free_voronoi(N, key=jax.random.key(0))]
    for start in starts:
        end = vx.equilibrate(start, ShapeFactorEnergy(3.7)).tissue
        assert jax.tree.map(kind, end) == jax.tree.map(kind, start)


def test_epochs_after_the_first_compile_nothing():
    counts = []
    for epochs in (1, 1, 3):  # the first fit compiles functions that all fits share
        with compilations() as count:
            vx.fit(problem(), optax.sgd(1e-3), epochs, progress=False)
        counts.append(count.n)
    # A new optimiser compiles its update once.
    assert counts[1] == counts[2] > 0


@pytest.mark.thorough
def test_equilibrate_gradient_and_fit_share_the_relaxation(monkeypatch):
    from vertax.relax import _loop

    traces = []
    advance = _loop.Search.advance
    record = lambda *args: (traces.append(None), advance(*args))[1]
    monkeypatch.setattr(_loop.Search, "advance", record)
    jax.clear_caches()
    eqx.clear_caches()
    tissue, energy = random_tissue(N, 2), ShapeFactorEnergy(jnp.full(N, 3.65))
    relaxed = vx.equilibrate(tissue, energy).tissue
    cost = vx.costs.VertexDistance(tissue)
    vx.InverseProblem(relaxed, energy, cost).value_and_gradient()
    assert any("_evaluate" in name for name in _programs)
    _programs.clear()
    FIT(vx.InverseProblem(relaxed, energy, cost), OPTIMISER)
    assert not any("_evaluate" in name for name in _programs)
    jax.grad(lambda e: cost(vx.equilibrate(tissue, e).tissue, e))(energy)
    assert len(traces) == 1


def test_adjoints_with_and_without_throw_share_the_program():
    problem().value_and_gradient()
    without_throw = vx.ImplicitDifferentiation(throw=False)
    with compilations() as count:
        problem(adjoint=without_throw).value_and_gradient()
    assert count.n == 0


def test_another_optimiser_compiles_only_its_update():
    FIT(problem(), OPTIMISER)
    with compilations() as count:
        FIT(problem(), optax.adam(1e-2))
    assert count.n <= 2  # initial state and update


@pytest.mark.thorough
def test_gradient_agrees_with_one_compiled_program():
    p = problem()
    shared = p.value_and_gradient()
    single = eqx.filter_jit(lambda: p.value_and_gradient(throw=False))()
    np.testing.assert_allclose(shared.cost, single.cost, rtol=1e-12)
    pair = shared.gradient.target_shape_factor, single.gradient.target_shape_factor
    np.testing.assert_allclose(*pair, rtol=1e-9)
