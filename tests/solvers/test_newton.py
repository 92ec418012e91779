"""Newton's method with a trust region for each vertex."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import vertax as vx
from vertax._base import rows as _rows

N = 30
PLACES = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (N, 2)))


def landscape(y, difficulty):
    """Wells, and in the place of the first one a short edge: hardly curved but at its tip."""
    edge = jnp.sqrt(jnp.sum((y[0] - PLACES[0]) ** 2) + 1e-8)
    return 0.5 * jnp.sum((y[1:] - PLACES[1:]) ** 2) + difficulty * edge, None


NEWTON = vx.solvers.NewtonCG()


def steps(fn, y, args, n, solver: Any = NEWTON, **scales):
    """The point after some steps, accepted or rejected, and the state of the solver."""
    value, aux = jax.eval_shape(fn, y, args)
    options = {"scales": vx.solvers.Scales(**scales)}
    state = solver.init(fn, y, args, options, value, aux, frozenset())

    def step(carry):
        y, state, k = carry
        y, state, _ = solver.step(fn, y, args, options, state, frozenset())
        return y, state, k + state.progress.stepped

    @jax.jit
    def run(n):
        unfinished = lambda carry: carry[2] < n
        return jax.lax.while_loop(unfinished, step, (y, state, jnp.array(0)))[:2]

    return run(n)


@pytest.mark.thorough
def test_one_difficult_region_does_not_slow_the_others():
    start = jnp.zeros((N, 2))
    radii = np.array([steps(landscape, start, 1.0, n)[1].radii for n in range(1, 12)])
    assert radii[:, 0].min() < 0.02
    assert radii[:, 0].min() < 0.5 * radii[:, 1:].min()
    y, _ = steps(landscape, start, 1.0, 6)
    np.testing.assert_allclose(y[1:], PLACES[1:], atol=1e-3)
    solution = optx.minimise(
        landscape, vx.solvers.NewtonCG(atol=1e-10), start, 1.0, has_aux=True, max_steps=200
    )
    np.testing.assert_allclose(solution.value, PLACES, atol=1e-8)


def test_a_rejected_step_shrinks_the_radii_of_wrong_vertices_alone():
    """Wells, and a wall in the way of one of many."""
    many = 2 * N
    places = jnp.concatenate([PLACES, PLACES])

    def wall(y, _):
        wells = 0.5 * jnp.sum((y[1:] - places[1:]) ** 2)
        return wells - y[0, 0] + 0.5e4 * jnp.maximum(y[0, 0] - 0.01, 0) ** 2, None

    y, state = steps(wall, jnp.zeros((many, 2)), None, 1)
    assert jnp.all(y == 0)
    assert state.radii[0] < 0.1
    np.testing.assert_allclose(state.radii[1:], 0.2)
    y, state = steps(wall, jnp.zeros((many, 2)), None, 4)
    assert jnp.all(jnp.linalg.norm(y[1:], axis=-1) > 0)


def needed(fn, start, radius=0.2, **settings):
    """How many steps it takes to come to rest, with radii of that size at first."""
    solver: Any = vx.solvers.NewtonCG(**settings)
    value, aux = jax.eval_shape(fn, start, None)
    state = solver.init(fn, start, None, {}, value, aux, frozenset())
    state = eqx.tree_at(lambda s: s.radii, state, jnp.full(N, radius))
    step = jax.jit(lambda y, state: solver.step(fn, y, None, {}, state, frozenset())[:2])
    y, n = start, 0
    while state.progress.force > 1e-8:
        y, state = step(y, state)
        n += bool(state.progress.stepped)
    return n


@pytest.mark.thorough
def test_radii_grow_fast_where_predictions_are_right():
    fn, start = lambda y, _: landscape(y, 0.0), jnp.zeros((N, 2))
    assert needed(fn, start, 1e-4) <= needed(fn, start) + 5  # 11 doublings


@pytest.mark.thorough
def test_radii_do_not_grow_where_steps_were_shortened():
    """The model predicted those steps well, and would propose them again without end."""
    solver: Any = vx.solvers.NewtonCG()
    far = lambda y, _: (0.5 * jnp.sum((y - 9.0) ** 2), None)
    _, after = steps(far, jnp.zeros((N, 2)), None, 3)
    fraction = jnp.where(jnp.arange(N) < 3, 0.0, 1.0)
    false, true = jnp.array(False), jnp.array(True)
    cut = solver.moved(after, fraction, false, true, vx.solvers.Scales())
    # (Not only a quarter of the radius, which may be much longer than the step.)
    taken = jnp.minimum(after.radii, _rows.sizes(after.proposal.step))
    assert (cut.radii[:3] <= 0.25 * taken[:3]).all()
    np.testing.assert_array_equal(cut.radii[3:], after.radii[3:])
    # If short steps do not help either, they start again with the largest radius.
    radii = []
    for _ in range(12):
        cut = solver.moved(cut, fraction, false, true, vx.solvers.Scales())
        radii.append(float(cut.radii[0]))
    assert min(radii) < 1e-4
    assert 0.2 in radii


@pytest.mark.thorough
@pytest.mark.parametrize("n", [1, 2, 3])
def test_disjoint_copies_take_the_steps_of_one(n):
    """How far a step is solved does not depend on the size of a tissue."""
    springs = jnp.logspace(0, 3, N)[:, None]

    def energy(y):
        return 0.5 * jnp.sum(springs * (y - PLACES) ** 2 + (y - jnp.roll(y, 1, 0)) ** 2)

    start = 1.001 * PLACES
    alone, _ = steps(lambda y, _: (energy(y), None), start, None, n)
    copies = lambda y, _: (jnp.sum(jax.vmap(energy)(y.reshape(4, N, 2))), None)
    together, _ = steps(copies, jnp.tile(start, (4, 1)), None, n)
    np.testing.assert_allclose(together.reshape(4, N, 2), jnp.stack(4 * [alone]), atol=1e-12)


@pytest.mark.thorough
def test_a_step_with_large_remaining_force_is_corrected():
    """Soft springs, which vertices may not follow to their ends in one step."""
    soft = lambda y, _: (0.5e-3 * jnp.sum((y - 2.0) ** 2), None)
    start = jnp.zeros((N, 2))
    assert needed(soft, start) <= 0.75 * needed(soft, start, max_corrections=0)


@pytest.mark.thorough
def test_a_cheap_step_is_corrected_earlier():
    """One wall that begins with the cube of the distance, as a contact, and others at rest."""

    def wall(y, _):
        others = 0.5 * jnp.sum((y[1:] - PLACES[1:]) ** 2) + 0.5 * y[0, 1] ** 2
        return others + 0.05 * jnp.maximum(1 - y[0, 0], 0) ** 3, None

    start = PLACES.at[0].set(0.0)
    # (Newton's method halves the distance, and quarters the force.)
    assert needed(wall, start) < 0.75 * needed(wall, start, cheap_products=0)


def test_typical_force_ignores_outliers():
    forces = jnp.zeros((101, 2)).at[:100, 0].set(1e-3).at[0, 0].set(1.0)
    assert np.mean(_rows.sizes(forces)) > 1e-2
    assert _rows.typical_size(forces) < 2e-3
    # What does not move does not count.
    np.testing.assert_allclose(_rows.typical_size(forces[1:]), 1e-3)
    assert _rows.typical_size(0 * forces) == 0


def test_steps_are_bounded_by_the_largest_displacement():
    hill = lambda y, _: (jnp.sum(jnp.cos(y)), None)  # concave where it starts
    start = 0.05 * jnp.ones((N, 2))
    y, _ = steps(hill, start, None, 1, length=0.5)
    far = jnp.sqrt(jnp.sum((y - start) ** 2, axis=-1))
    assert 0 < far.max() <= 2 * 0.2 * 0.5
    assert hill(y, None)[0] < hill(start, None)[0]


@pytest.mark.parametrize("scale", [1e-8, pytest.param(1e8, marks=pytest.mark.thorough)])
def test_steps_do_not_depend_on_the_unit_of_energy(scale):
    start = jnp.zeros((N, 2))
    scaled = lambda y, args: (scale * landscape(y, args)[0], None)
    y, _ = steps(scaled, start, 1.0, 5, stiffness=scale)
    expected, _ = steps(landscape, start, 1.0, 5, stiffness=1.0)
    np.testing.assert_allclose(y, expected, atol=1e-9)


def test_rounding_of_an_energy_far_below_its_unit_is_ignored():
    """Lengths are almost what they should be: so their differences are known less well than themselves."""
    far = jnp.array([[1.0, 0.2], [-0.6, 0.9], [-0.3, -1.1]])
    lengths = lambda y: jnp.sum(jnp.linalg.norm(y[:, None] - far, axis=-1), axis=-1)

    def strained(y, _):
        change = lengths(y) - lengths(PLACES)
        return 0.5 * jnp.sum((change - 1e-6) ** 2) + 0.5 * jnp.sum((y - PLACES) ** 2), None

    def rest(start):
        solver = vx.solvers.NewtonCG(atol=1e-14)
        return optx.minimise(strained, solver, start, has_aux=True, max_steps=20)

    at_rest = rest(PLACES).value
    for key in jax.random.split(jax.random.key(0), 8):
        start = at_rest + 3e-12 * jax.random.normal(key, (N, 2))
        assert rest(start).stats["num_steps"] < 8  # evaluations


@pytest.mark.thorough
def test_steps_follow_a_curved_valley():
    """The floor is a circle, and falls gently around it."""
    tilt = 1e-4

    def valley(y, _):
        radius = jnp.sqrt(jnp.sum(y**2, axis=-1))
        return jnp.sum(0.5 * (radius - 1) ** 2 - tilt * y[:, 0]), None

    angles = jnp.linspace(1.0, 2.5, N)
    start = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    solution = optx.minimise(
        valley, vx.solvers.NewtonCG(atol=1e-10), start, has_aux=True, max_steps=400
    )
    np.testing.assert_allclose(solution.value[:, 0], 1 + tilt, atol=1e-6)
    assert needed(valley, start) < 0.75 * needed(valley, start, max_corrections=0)


@pytest.mark.thorough
def test_fluid_tissues_relax_without_creeping():
    relax = eqx.filter_jit(vx.Relaxation(tolerance=1e-8, max_steps=600))
    for seed in (22, 49, 66, 71, 105, 106):  # 170 to 560 steps each without corrections
        tissue = vx.initialise.periodic_voronoi(64, key=jax.random.key(1000 + seed))
        factors = 3.9 + 0.1 * jax.random.normal(jax.random.key(2000 + seed), (64,))
        assert relax(tissue, vx.energies.ShapeFactorEnergy(factors)).num_steps < 160
