"""Growth of tissues: divisions, deaths, lineage and gradients."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, central_difference, random_tissue

import vertax as vx
from vertax.growth import GrowAndDivide, grow

FRICTION = vx.dissipations.SubstrateFriction(1.0)


def energy_of(cells):
    return (
        vx.energies.AreaElasticity(1.0, cells.target_area)
        + vx.energies.PerimeterElasticity(0.02, 0.0)
        + vx.energies.LineTension(0.02)
    )


def founders(capacity=9):
    return vx.initialise.free_voronoi(4, key=0, lloyd_steps=2).with_capacity(capacity)


# Contacts and transitions make compilation several times longer.
RELAXATIONS = [
    pytest.param(FIXED_TOPOLOGY, id="still"),
    pytest.param(vx.Relaxation(), id="default", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module", params=RELAXATIONS)
def grown(request):
    cycle, times = GrowAndDivide(0.2, 1.5), jnp.linspace(0, 4, 6)
    return grow(founders(), energy_of, cycle, times, key=1, relaxation=request.param)


def test_cells_divide_and_the_tissue_stays_valid(grown):
    n_alive = np.asarray(grown.n_alive)
    assert n_alive[0] == 4
    assert n_alive[-1] > 5
    assert (np.diff(n_alive) >= 0).all()
    for frame in grown.trajectory:
        frame.topology.validate()
        assert not frame.overlaps.any
    assert grown.converged
    np.testing.assert_array_equal(grown.number[-1] >= 0, grown.tissue.alive)
    # A daughter inherits half the target area of the mother.
    young = np.asarray(grown.tissue.alive & (grown.cells.age == 0))
    assert (np.asarray(grown.cells.target_area)[young] < 1.2).all()


@pytest.mark.thorough
def test_a_growth_with_a_checkpoint_continues(tmp_path):
    def run(n, rate=0.2, **settings):
        cycle, times = GrowAndDivide(rate, 1.5), jnp.linspace(0, 4, 6)[:n]
        return grow(
            founders(), energy_of, cycle, times, key=1, relaxation=FIXED_TOPOLOGY, **settings
        )

    file = tmp_path / "growth.npz"
    at_once, _ = run(6), run(3, checkpoint=file)
    continued = run(6, checkpoint=file)
    assert at_once.n_alive[2] < at_once.n_alive[-1]
    np.testing.assert_array_equal(at_once.number, continued.number)
    np.testing.assert_array_equal(at_once.lineage.mother, continued.lineage.mother)
    np.testing.assert_allclose(at_once.frames.vertices, continued.frames.vertices, atol=1e-7)
    np.testing.assert_allclose(at_once.cells_then.age, continued.cells_then.age, atol=1e-12)
    with pytest.raises(ValueError, match="checkpoint of a growth with another tissue, energy or"):
        run(6, rate=0.3, checkpoint=file)


@pytest.mark.thorough
def test_daughters_inherit_the_states_of_activities(without_type_checks):
    activity = vx.activities.SelfPropulsion(0.02, 0.1, 0.5) + vx.activities.FluctuatingTensions(
        0.01, 1
    )
    grown = grow(
        founders(),
        energy_of,
        GrowAndDivide(0.2, 1.5),
        jnp.linspace(0, 2, 5),
        key=1,
        dissipation=FRICTION,
        activity=activity,
        relaxation=FIXED_TOPOLOGY,
    )
    assert grown.n_alive[-1] > 4
    assert grown.signals is None
    change = vx.transitions.divide(founders(), 2)
    state = activity.init(founders(), jax.random.key(0))
    propulsion, tensions = change.inherited(state, axis="cells")
    assert propulsion.angles[4] == state[0].angles[2]
    np.testing.assert_array_equal(tensions.relative, state[1].relative[change.edges])
    with pytest.raises(TypeError, match="`activity` must be"):
        grow(
            founders(),
            energy_of,
            GrowAndDivide(0.2, 1.5),
            [0.0, 1.0],
            key=1,
            activity=energy_of,  # pyright: ignore[reportArgumentType]
        )


@pytest.mark.thorough
def test_failed_divisions_and_deaths_are_counted():
    tissue, times = vx.initialise.free_voronoi(2, key=0).with_capacity(5), jnp.linspace(0, 10, 9)
    run = lambda cycle: grow(
        tissue, energy_of, cycle, times, key=1, relaxation=FIXED_TOPOLOGY, throw=False
    )
    grown = run(GrowAndDivide(0.2, 1.5))
    assert grown.n_alive[0] == 2
    assert grown.n_alive[-1] == 5
    for frame in grown.trajectory:
        frame.topology.validate()
        assert not frame.overlaps.any
    # Failed divisions are counted once all slots are used.
    assert grown.result == vx.RESULTS.capacity_reached
    assert not grown.converged
    failed = np.asarray(grown.failed_divisions)
    assert failed[-1] > 0
    assert (failed[np.asarray(grown.n_alive) < 5] == 0).all()
    assert (np.diff(failed) >= 0).all()
    assert (grown.failed_deaths == 0).all()
    # Cells cannot be removed without T2 transitions.
    dying = run(GrowAndDivide(0.0, 1.5, death_rate=10.0, shrinking_time=0.3))
    assert dying.n_alive[-1] == 2
    assert dying.failed_deaths[0] == 0
    assert dying.failed_deaths[-1] >= 2
    assert (dying.failed_divisions == 0).all()


@pytest.mark.thorough
def test_growth_can_start_from_one_periodic_cell():
    tissue, times = random_tissue(1).with_capacity(5), jnp.linspace(0, 8, 9)
    cycle = GrowAndDivide(0.2, 1.5)
    grown = grow(tissue, energy_of, cycle, times, key=1, relaxation=FIXED_TOPOLOGY)
    assert grown.n_alive[0] == 1
    assert grown.n_alive[-1] > 2
    assert grown.tissue.areas.sum() == pytest.approx(1)


def test_lineage_is_a_binary_forest(grown):
    lineage = grown.lineage
    count = int(lineage.count)
    mother, fate = np.asarray(lineage.mother)[:count], np.asarray(lineage.fate)[:count]
    begun, ended = np.asarray(lineage.begun)[:count], np.asarray(lineage.ended)[:count]
    born = mother >= 0
    assert (mother[:4] == -1).all()
    assert born[4:].all()
    assert (mother[born] < np.flatnonzero(born)).all()
    np.testing.assert_array_equal(np.bincount(mother[born], minlength=count), 2 * (fate == 1))
    np.testing.assert_array_equal(begun[born], ended[mother[born]])
    np.testing.assert_array_equal(np.isinf(ended), fate == 0)
    alive = np.asarray(grown.number)[-1]
    assert sorted(alive[alive >= 0]) == np.flatnonzero(fate == 0).tolist()


def test_exhausted_capacity_and_invalid_arguments_are_rejected(grown, without_type_checks):
    cycle, times = GrowAndDivide(0.2, 1.5), jnp.linspace(0, 5, 6)
    result = lambda time: vx.RESULTS.where(
        time > 3, vx.RESULTS.capacity_reached, vx.RESULTS.successful
    )
    full = dataclasses.replace(grown, results=jax.vmap(result)(grown.times))
    with pytest.raises(RuntimeError, match=r"all cell slots .* alive.*9 cell slots"):
        full.checked()
    with pytest.raises(RuntimeError, match=r"all cell slots .* alive"):
        jax.block_until_ready(eqx.filter_jit(lambda g: g.checked().times)(full))
    with pytest.raises(ValueError, match="with_capacity"):
        grow(random_tissue(6), energy_of, cycle, times, key=0)
    with pytest.raises(ValueError, match="orientation"):
        GrowAndDivide(0.2, 1.5, orientation="short")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="`times`"):
        grow(founders(), energy_of, cycle, jnp.zeros(3), key=0)


@pytest.mark.slow
def test_dying_cells_are_extruded():
    tissue = random_tissue(12, 3, lloyd_steps=5).with_capacity(12)
    cycle = GrowAndDivide(0.0, 2.0, death_rate=0.15, shrinking_time=0.3)
    energy = lambda cells: energy_of(cells) + vx.energies.LineTension(0.03)
    grown = grow(tissue, energy, cycle, jnp.linspace(0, 4, 9), key=2)
    grown.tissue.topology.validate()
    n_dead = int((grown.lineage.fate == 2).sum())
    assert n_dead > 0
    assert n_dead == 12 - int(grown.n_alive[-1])
    assert grown.tissue.areas.sum() == pytest.approx(12.0)


@pytest.mark.slow
def test_growth_rate_gradient_matches_finite_differences():
    tissue = founders(8)
    relaxation = vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-11)

    @eqx.filter_jit
    def size(rate):
        cycle = GrowAndDivide(rate, 1.5)
        times = jnp.linspace(0, 2, 5)
        grown = grow(
            tissue,
            energy_of,
            cycle,
            times,
            key=1,
            dissipation=FRICTION,
            relaxation=relaxation,
            divisions=1,
            throw=False,
        )
        return jnp.sum(grown.tissue.areas**2), grown.lineage.count

    rate = jnp.asarray(0.2)
    (_, count), slope = jax.value_and_grad(size, has_aux=True)(rate)
    assert count > 4
    assert slope == pytest.approx(
        float(central_difference(lambda r: size(r)[0], rate, 1.0, 1e-5)), rel=1e-5
    )


def test_daughters_grow_before_they_divide():
    cycle = GrowAndDivide(0.1, 1.0, variation=0.5)
    tissue = random_tissue(12)
    mothers = cycle.init(tissue, jax.random.key(0))
    mothers = eqx.tree_at(lambda c: c.target_area, mothers, jnp.linspace(0.6, 1.9, 12))

    def division_areas(key):
        born = cycle.born(mothers, tissue, jnp.array([10, 11]), key)
        return born.division_area[10:] / born.target_area[10:]

    ratios = jax.vmap(division_areas)(jax.random.split(jax.random.key(1), 500))
    assert float(ratios.min()) >= 1.2 * (1 - 1e-6)
    # Areas of small daughters are normal, with the mean and the variation of the cycle.
    areas = GrowAndDivide(0.1, 2.0, variation=0.1)._draw_division_areas(
        jax.random.key(2), jnp.zeros(2000)
    )
    assert float(areas.mean()) == pytest.approx(2.0, rel=0.01)
    assert float(areas.std()) == pytest.approx(0.2, rel=0.06)
    exact = GrowAndDivide(0.1, 2.0, variation=0.0)._draw_division_areas(
        jax.random.key(2), jnp.full(3, 0.5)
    )
    np.testing.assert_allclose(exact, 2.0)


@pytest.mark.thorough
def test_growth_ends_when_one_of_the_last_two_cells_of_a_free_tissue_dies():
    cycle = GrowAndDivide(0.0, 1.5, death_rate=1.0, shrinking_time=0.5)
    tissue = vx.initialise.free_voronoi(2, key=0).with_capacity(3)
    energy = lambda cells: (
        vx.energies.AreaElasticity(1.0, cells.target_area) + (vx.energies.LineTension(0.1))
    )
    times = jnp.linspace(0, 6, 13)
    grown = grow(tissue, energy, cycle, times, key=1, relaxation=FIXED_TOPOLOGY, throw=False)
    assert grown.result == vx.RESULTS.too_few_cells
    assert grown.n_alive[-1] == 2
    for frame in grown.trajectory:
        assert not frame.overlaps.any
        assert (np.asarray(frame.areas)[np.asarray(frame.alive)] > 1e-3).all()
    with pytest.raises(RuntimeError, match="needs two cells"):
        grown.checked()
