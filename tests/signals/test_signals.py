"""Signals: exchange, dilution, coupling, gradients, transitions and errors."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, NO_CONTACT, central_difference, random_like, random_tissue
from scipy.linalg import expm

import vertax as vx
from vertax.activities import SelfPropulsion, ThermalNoise
from vertax.dissipations import EdgeViscosity, SubstrateFriction
from vertax.dynamics import Material, PIController
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity, ShapeFactorEnergy
from vertax.signals import AbstractReaction, Signals
from vertax.signals._exchange import Exchange

FRICTION = SubstrateFriction(1.0)
ENERGY = ShapeFactorEnergy(3.7)
KEY = jax.random.key(0)
EXACT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12}


class Linear(AbstractReaction):
    matrix: jax.Array

    def __call__(self, concentrations, cells, time):
        return self.matrix @ concentrations


class Turnover(AbstractReaction):
    rate: jax.Array | float

    def __call__(self, concentrations, cells, time):
        a, b = concentrations
        return self.rate * jnp.stack([cells.areas - a, a**2 - b])


class Contraction(eqx.Module):
    strength: jax.Array | float

    def __call__(self, concentrations, tissue):
        return AreaElasticity(1.0, 1 - self.strength * concentrations[0])


def after(signals, tissue, dt):
    """Concentrations after one step of reaction and exchange."""

    @eqx.filter_jit
    def run(signals, tissue, dt):
        state = signals.init(tissue, KEY)
        _, state = signals.drive(state, tissue, FRICTION, jnp.zeros_like(dt), dt, KEY)
        return signals.record(state, tissue)

    return run(signals, tissue, jnp.asarray(dt, tissue.vertices.dtype))


def total(concentrations, tissue):
    return jnp.sum(concentrations * tissue.areas, axis=-1)


@functools.cache
def initial_tissue():
    return random_tissue(6, 0)


def evolve(activity, times=(0.0, 0.2, 0.4), tissue=None, energy=ENERGY, **settings):
    tissue = initial_tissue() if tissue is None else tissue
    options: dict[str, Any] = {"relaxation": FIXED_TOPOLOGY} | settings
    return vx.evolve(tissue, energy, FRICTION, list(times), activity=activity, **options)


class TestExchange:
    def test_two_cells_approach_each_other_exponentially(self):
        tissue = vx.initialise.free_voronoi(2, key=1)
        start = np.array([2.0, 0.5])
        concentrations = after(Signals(None, [0.7], initial=start[None], **EXACT), tissue, 0.4)[0]
        shared = np.all(np.asarray(tissue.topology.edge_cells) < 2, axis=1)
        vector = np.asarray(tissue.edge_vectors)[shared][0]
        distance = np.linalg.norm(np.diff(np.asarray(tissue.centroids), axis=0))
        conductance = 0.7 * np.linalg.norm(vector) / distance
        areas = np.asarray(tissue.areas)
        matrix = conductance * np.array([[-1, 1], [1, -1]]) / areas[:, None]
        np.testing.assert_allclose(concentrations, expm(0.4 * matrix) @ start, rtol=1e-9)

    def test_a_row_of_cells_obeys_the_diffusion_equation(self):
        # The error of the rate of a mode cos(kx) is proportional to (k d)².
        errors = []
        for n in (8, 16):
            tissue = vx.initialise.hexagonal(n, 2)
            width = float(tissue.boundary.lattice[0, 0])
            k = 2 * np.pi / width
            wave = 1 + 0.5 * np.cos(k * np.asarray(tissue.centroids)[:, 0])
            rate = 1.3 * k**2
            decayed = after(Signals(None, [1.3], initial=wave[None], **EXACT), tissue, 0.5 / rate)
            amplitude = 2 * np.mean((decayed[0] - 1) * (wave - 1)) / 0.5**2
            errors.append(abs(-np.log(amplitude) / 0.5 - 1))
            assert errors[-1] < 0.1 * (k * width / n) ** 2
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)

    @pytest.mark.parametrize("solver", [None, diffrax.Kvaerno3()])
    def test_amounts_are_conserved(self, solver):
        tissue = random_tissue(9, 2, lattice=3 * np.array([[1.2, 0.0], [0.4, 1 / 1.2]]))
        start = 1 + jax.random.uniform(KEY, (2, 9))
        concentrations = after(Signals(None, [3.0, 0.2], initial=start, solver=solver), tissue, 2)
        before, now = total(start, tissue), total(concentrations, tissue)
        np.testing.assert_allclose(now, before, rtol=2e-15)
        assert np.ptp(concentrations[0]) < 0.1 * np.ptp(start[0])

    def test_an_edge_of_length_zero_exchanges_nothing_and_has_finite_gradients(self):
        tissue = vx.initialise.hexagonal(3, 2)
        _, second = np.asarray(tissue.topology.edge_vertices)[0]
        flat = tissue.vertices.at[second].add(-tissue.edge_vectors[0])
        conductance = lambda x: Exchange.of(tissue.with_vertices(x)).conductance
        assert conductance(flat)[0] == pytest.approx(0, abs=1e-12)
        slope = jax.jit(jax.grad(lambda x: jnp.sum(conductance(x))))(flat)
        assert np.isfinite(slope).all()

    def test_stiff_reactions_match_the_matrix_exponential(self):
        matrix = np.array([[-2000.0, 1.0], [1999.0, -1.0]])
        signals = Signals(
            Linear(jnp.asarray(matrix)),
            [0.0, 0.0],
            initial=jnp.array([1.0, 0.5]),
            solver=diffrax.Kvaerno3(),
            rtol=1e-8,
            atol=1e-12,
            max_steps=2000,
        )
        exact = expm(0.5 * matrix) @ np.array([1.0, 0.5])
        concentrations = after(signals, vx.initialise.hexagonal(2, 2), 0.5)
        np.testing.assert_allclose(concentrations, np.repeat(exact[:, None], 4, 1), rtol=1e-6)

    @pytest.mark.thorough
    def test_float32(self):
        tissue = jax.tree.map(
            lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, random_tissue(6, 0)
        )
        start = jnp.linspace(1, 2, 12, dtype=jnp.float32).reshape(2, 6)
        signals = Signals(Turnover(0.5), [0.1, 0.2], initial=start, rtol=1e-10)  # below rounding
        concentrations = after(signals, tissue, 0.5)
        assert concentrations.dtype == jnp.float32
        double = after(Signals(Turnover(0.5), [0.1, 0.2], initial=start), random_tissue(6, 0), 0.5)
        np.testing.assert_allclose(concentrations, double, rtol=3e-5)


class TestEvolution:
    @pytest.mark.thorough
    def test_dilution_keeps_the_amount_of_diluted_species_and_the_others_constant(self):
        tissue = initial_tissue()
        start = jnp.linspace(1, 2, 12).reshape(2, 6)
        signals = Signals(None, [0.0, 0.0], initial=start, diluted=(True, False))
        boundary = lambda time: vx.Periodic((1 + 0.5 * time) * tissue.boundary.lattice)
        movie = evolve(signals, tissue=tissue, boundary=boundary)
        amounts = start[0] * tissue.areas
        np.testing.assert_allclose(movie.signals[-1, 0] * movie.tissue.areas, amounts, rtol=1e-13)
        np.testing.assert_allclose(movie.signals[:, 1], np.tile(start[1], (3, 1)), rtol=1e-14)
        assert movie.signals.shape == (3, 2, 6)

    @pytest.mark.thorough
    def test_a_coupled_material_acts_as_its_parts(self):
        concentrations = jnp.linspace(0.5, 1, 6)
        friction = EdgeViscosity(0.3) + SubstrateFriction(0.5)

        def couple(c, tissue):
            cells = tissue.topology.edge_cells
            return Material(LineTension(0.1 * jnp.mean(c[0][cells], axis=-1)), friction)

        signals = Signals(None, [0.0], initial=concentrations[None], couple=couple, diluted=False)
        tissue = initial_tissue()
        tensions = 0.1 * jnp.mean(concentrations[tissue.topology.edge_cells], axis=-1)
        expected = vx.evolve(
            tissue,
            ENERGY + LineTension(tensions),
            friction,
            [0.0, 0.2, 0.4],
            relaxation=FIXED_TOPOLOGY,
        )
        for order in (1, 2):
            movie = evolve(signals, order=order)
            if order == 1:
                # (The inversion barrier of driven tissues changes the positions by 1e-6.)
                np.testing.assert_allclose(
                    movie.tissue.vertices, expected.tissue.vertices, atol=1e-5
                )
        assert movie.converged

    @pytest.mark.thorough
    def test_couple_is_called_once_in_each_traced_step(self):
        calls = []

        def couple(c, tissue):
            calls.append(None)
            return Material(AreaElasticity(1.0, c[0]), None, SelfPropulsion(0.1))

        signals = Signals(None, [0.0], initial=[1.0], couple=couple, deterministic=False)
        state = signals.init(initial_tissue(), KEY)
        assert len(calls) == 1
        now = jnp.array(0.0)
        _, state = signals.drive(state, initial_tissue(), FRICTION, now, now + 0.1, KEY)
        assert signals.step_dissipation(state, initial_tissue(), FRICTION) is FRICTION
        state = signals.finish(state, initial_tissue(), initial_tissue())
        assert len(calls) == 2
        assert state.material is None
        both = signals + ThermalNoise(0.1)
        states = (state, None)
        _, states = both.drive(states, initial_tissue(), FRICTION, now, now + 0.1, KEY)
        assert both.step_dissipation(states, initial_tissue(), FRICTION) is FRICTION
        states = both.finish(states, initial_tissue(), initial_tissue())
        assert len(calls) == 3

    def test_order_2_rejects_a_coupled_dissipation_before_the_first_stage(self, monkeypatch):
        class Contact(vx.AbstractDissipation):
            def __call__(self, tissue, before, dt):
                return jnp.sum(jnp.abs(tissue.vertices - before.vertices) ** 3)

        couple = lambda c, tissue: Material(AreaElasticity(1.0, c[0]), Contact())
        monkeypatch.setattr(
            vx.Relaxation, "solve", lambda *args, **settings: pytest.fail("a stage")
        )
        with pytest.raises(ValueError, match=r"`order` can be 2 only .* which Contact is not"):
            evolve(Signals(None, [0.0], initial=[1.0], couple=couple), order=2)

    @pytest.mark.thorough
    def test_a_coupled_activity_acts_and_needs_a_key(self):
        couple = lambda c, tissue: Material(
            AreaElasticity(0.0, 1.0), None, SelfPropulsion(0.2 * c[0], 0.5)
        )
        arguments: dict[str, Any] = {
            "initial": jnp.linspace(0.5, 1, 6)[None],
            "couple": couple,
            "diluted": False,
        }
        passive = evolve(None).tissue.vertices
        movie = evolve(Signals(None, [0.0], **arguments, deterministic=False), key=1)
        assert jnp.max(jnp.abs(movie.tissue.vertices - passive)) > 1e-2
        with pytest.raises(ValueError, match="deterministic=False"):
            evolve(Signals(None, [0.0], **arguments))
        with pytest.raises(ValueError, match="`key` is missing"):
            evolve(Signals(None, [0.0], **arguments, deterministic=False))

    @pytest.mark.thorough
    def test_gradients_match_finite_differences(self):
        initial_tissue()  # made outside of the compiled function

        def loss(p):
            signals = Signals(
                Turnover(p["rate"]),
                [*p["diffusion"]],
                initial=p["initial"],
                couple=Contraction(p["k"]),
                **EXACT,
            )
            movie = evolve(signals)
            weights = jnp.cos(jnp.arange(movie.signals.size)).reshape(movie.signals.shape)
            return jnp.sum(weights * movie.signals) + jnp.sum(movie.tissue.perimeters**2)

        p = {
            "rate": jnp.array(0.7),
            "diffusion": jnp.array([0.3, 0.1]),
            "initial": 1 + 0.3 * jnp.sin(jnp.arange(12.0)).reshape(2, 6),
            "k": jnp.array(0.2),
        }
        slopes, value = jax.jit(jax.grad(loss))(p), jax.jit(loss)
        for name in p:
            direction = {k: jnp.zeros_like(v) for k, v in p.items()}
            direction[name] = random_like(p[name], 1)
            difference = central_difference(value, p, direction, 1e-4)
            assert jnp.vdot(slopes[name], direction[name]) == pytest.approx(difference, rel=1e-7)

    @pytest.mark.thorough
    def test_rates_are_parameters_of_inverse_problems(self):
        signals = Signals(
            Turnover(jnp.array(0.5)), [0.1, 0.2], initial=[1.0, 0.5], couple=Contraction(0.2)
        )
        material = Material(ENERGY, FRICTION, signals)
        cost = vx.costs.CellAreas(jnp.ones(6))
        response = vx.Evolution(FRICTION, [0.0, 0.2], relaxation=FIXED_TOPOLOGY)
        problem = vx.InverseProblem(initial_tissue(), material, cost, response=response)
        evaluation = problem.value_and_gradient(material)
        assert abs(evaluation.gradient.activity.reaction.rate) > 1e-6

    @pytest.mark.thorough
    def test_a_batch_gives_the_results_of_its_members(self):
        run = lambda initial: evolve(
            Signals(Turnover(0.5), [0.1, 0.2], initial=initial, couple=Contraction(0.2)),
            throw=False,
        )
        starts = 1 + jax.random.uniform(KEY, (2, 2, 6))
        batch = eqx.filter_vmap(run)(starts)
        assert batch.converged.all()
        np.testing.assert_allclose(batch.signals[1], run(starts[1]).signals, rtol=1e-6)

    @pytest.mark.thorough
    def test_adaptive_steps_limit_the_error_of_concentrations(self):
        # The reaction is fast and the tissue moves with it.
        make = lambda: Signals(
            Turnover(3.0), [0.0, 0.0], initial=jnp.array([1.0, 0.2]), couple=Contraction(0.3)
        )
        exact = evolve(make(), (0.0, 1.0), substeps=400).signals[-1]
        errors = []
        for tolerance in (1e-2, 1e-3):
            control = PIController(tolerance, max_steps=200)
            movie = evolve(make(), (0.0, 1.0), stepsize_controller=control)
            errors.append(np.max(np.abs(movie.signals[-1] - exact)))
            assert errors[-1] < 10 * tolerance**0.5
        assert errors[1] < 0.5 * errors[0]

    @pytest.mark.thorough
    def test_a_checkpoint_continues_bitwise(self, tmp_path):
        signals = Signals(Turnover(0.5), [0.1, 0.2], initial=[1.0, 0.5], couple=Contraction(0.2))
        uninterrupted = evolve(signals, checkpoint=tmp_path / "one.npz")
        evolve(signals, (0.0, 0.2), checkpoint=tmp_path / "two.npz")
        continued = evolve(signals, checkpoint=tmp_path / "two.npz")
        np.testing.assert_array_equal(continued.signals, uninterrupted.signals)
        np.testing.assert_array_equal(continued.tissue.vertices, uninterrupted.tissue.vertices)

    @pytest.mark.thorough
    def test_concentrations_are_in_trajectories_and_files(self, tmp_path):
        movie = evolve(Signals(Turnover(0.5), [0.1, 0.2], initial=[1.0, 0.5]))
        vx.save(tmp_path / "movie.npz", movie.trajectory)
        loaded = vx.load(tmp_path / "movie.npz", vx.mesh.Trajectory)
        np.testing.assert_array_equal(loaded.values["signals"], movie.signals)
        vx.animate(movie.trajectory, tmp_path / "movie.gif", movie.signals[:, 0], dpi=40)
        table = vx.io.cell_table(movie.tissue, activator=movie.signals[-1, 0])
        np.testing.assert_array_equal(table["activator"], movie.signals[-1, 0])
        vx.io.write_vtk_series(
            tmp_path / "movie.pvd", movie.trajectory, cells={"activator": movie.signals[:, 0]}
        )

    @pytest.mark.thorough
    def test_a_failed_solver_is_a_result(self):
        class Explosion(AbstractReaction):
            def __call__(self, concentrations, cells, time):
                return concentrations**2

        movie = evolve(Signals(Explosion(), [0.0], initial=[100.0]), throw=False)
        assert movie.result == vx.RESULTS.signals_not_finite
        with pytest.raises(RuntimeError, match="concentrations of signals are not finite"):
            movie.checked()


class TestTransitions:
    @pytest.mark.thorough
    def test_neighbours_share_the_amount_of_a_cell_that_vanishes(self):
        tissue = random_tissue(9, 1).with_capacity(11)
        start = jnp.arange(1.0, 12.0)[None] + jnp.zeros((2, 1))
        signals = Signals(None, [0.1, 0.1], initial=start, diluted=(True, False))
        removed = vx.transitions.remove(tissue, 4).tissue
        state = signals.init(tissue, KEY)
        ended = signals.finish(state, tissue, removed)
        np.testing.assert_allclose(jnp.sum(ended.amounts[0]), jnp.sum(state.amounts[0]), rtol=1e-15)
        cells = np.asarray(tissue.topology.edge_cells)
        neighbours = np.unique(cells[np.any(cells == 4, axis=1)])
        gained = np.asarray(ended.amounts[0] - state.amounts[0])
        assert (gained[np.setdiff1d(neighbours, 4)] > 0).all()
        others = np.setdiff1d(np.arange(11), neighbours)
        np.testing.assert_array_equal(gained[others], 0)
        np.testing.assert_array_equal(
            ended.amounts[1], np.where(removed.alive, state.amounts[1], 0)
        )
        assert (signals.record(ended, removed)[:, ~np.asarray(removed.alive)] == 0).all()

    @pytest.mark.thorough
    def test_daughters_share_amounts_by_area(self):
        tissue = random_tissue(9, 1).with_capacity(11)
        signals = Signals(None, [0.1, 0.1], initial=[2.0, 3.0], diluted=(True, False))
        change = vx.transitions.divide(tissue, 4)
        state = signals.init(tissue, KEY)
        pair = jnp.array([4, 9])
        ended = signals.born(change.inherited(state, axis="cells"), change.tissue, pair)
        np.testing.assert_allclose(jnp.sum(ended.amounts[0]), jnp.sum(state.amounts[0]), rtol=1e-15)
        concentrations = np.asarray(signals.record(ended, change.tissue))
        np.testing.assert_allclose(concentrations[0, pair], 2.0, rtol=1e-12)
        np.testing.assert_allclose(concentrations[1, pair], 3.0, rtol=1e-14)

    @pytest.mark.slow
    def test_amounts_are_constant_through_divisions_and_deaths(self):
        def energy(cells):
            target = cells.target_area
            return AreaElasticity(10.0, target) + PerimeterElasticity(1.0, 3.6 * jnp.sqrt(target))

        tissue = vx.initialise.free_voronoi(8, key=0).with_capacity(40)
        signals = Signals(None, [0.5, 0.0], initial=jnp.array([1.0, 2.0]))
        cycle = vx.growth.GrowAndDivide(0.5, 1.5, death_rate=0.2, shrinking_time=0.3)
        grown = vx.growth.grow(
            tissue,
            energy,
            cycle,
            np.linspace(0, 3, 31),
            key=1,
            dissipation=FRICTION,
            activity=signals,
        )
        areas = jax.vmap(lambda t: t.areas)(grown.frames)
        amounts = jnp.sum(grown.signals * areas[:, None], axis=-1)
        np.testing.assert_allclose(amounts, np.tile(amounts[0], (31, 1)), rtol=1e-12)
        assert jnp.sum(grown.lineage.fate == 1) >= 20
        assert jnp.sum(grown.lineage.fate == 2) >= 1
        assert (grown.signals[:, :, -1] == 0).all()  # a spare slot

    @pytest.mark.slow
    def test_amounts_are_constant_through_a_hundred_t1_transitions(self):
        tissue = random_tissue(30, 0)
        lattice = tissue.boundary.lattice
        flowing = vx.evolve(
            tissue,
            ENERGY,
            FRICTION,
            np.linspace(0, 8, 161),
            activity=Signals(None, [0.5], initial=1 + jax.random.uniform(KEY, (1, 30))),
            boundary=lambda time: vx.Periodic(lattice.at[1].add(time * lattice[0])),
            relaxation=NO_CONTACT,
        )
        assert flowing.num_t1 >= 100
        areas = jax.vmap(lambda t: t.areas)(flowing.frames)
        amounts = jnp.sum(flowing.signals[:, 0] * areas, axis=-1)
        np.testing.assert_allclose(amounts, amounts[0], rtol=1e-12)


class TestErrors:
    @pytest.mark.parametrize(
        ("settings", "match"),
        [
            ({"initial": [-1.0, 1.0]}, "`initial` must be at least 0"),
            ({"initial": [np.nan, 1.0]}, "`initial` must be finite"),
            ({"diffusion": [-0.1, 0.1]}, "`diffusion` must be at least 0"),
            ({"diffusion": [np.inf, 0.1]}, "`diffusion` must be finite"),
            ({"diffusion": [0.1]}, "one row per species"),
            ({"reaction": Turnover(np.nan)}, "reaction.rate"),
            ({"diluted": (True,)}, "`diluted`"),
            ({"rtol": 0.0}, "`rtol`"),
            ({"max_steps": 0}, "`max_steps`"),
        ],
    )
    def test_invalid_values_are_rejected(self, settings, match):
        arguments: dict[str, Any] = {
            "reaction": Turnover(1.0),
            "diffusion": [0.1, 0.1],
            "initial": [1.0, 1.0],
        } | settings
        with pytest.raises(ValueError, match=match):
            Signals(arguments.pop("reaction"), arguments.pop("diffusion"), **arguments)

    def test_invalid_types_are_rejected(self, without_type_checks):
        for reaction in (lambda c, cells, time: -c, Turnover):
            with pytest.raises(TypeError, match="`reaction` must be"):
                Signals(reaction, [0.1], initial=[1.0])  # pyright: ignore[reportArgumentType]
        for couple in (ENERGY, 1.0):
            with pytest.raises(TypeError, match="`couple` must be a function"):
                Signals(None, [0.1], initial=[1.0], couple=couple)  # pyright: ignore[reportArgumentType]
        with pytest.raises(TypeError, match="`solver` must be"):
            Signals(None, [0.1], initial=[1.0], solver="stiff")

    def test_invalid_reactions_are_rejected_by_name_at_the_first_step(self):
        class Flat(AbstractReaction):
            def __call__(self, concentrations, cells, time):
                return concentrations[0]

        class Foreign(AbstractReaction):
            def __call__(self, concentrations, cells, time) -> Any:
                return np.sin(np.asarray(concentrations))

        with pytest.raises(ValueError, match=r"`Flat` must return .*shape \(1, 6\).*\(6,\)"):
            evolve(Signals(Flat(), [0.1], initial=[1.0]))
        with pytest.raises(TypeError, match=r"`Foreign` must use jax\.numpy"):
            evolve(Signals(Foreign(), [0.1], initial=[1.0]))
        with pytest.raises(ValueError, match=r"`initial` must have shape .* or \(1, 6\)"):
            evolve(Signals(None, [0.1], initial=jnp.ones((1, 5))))
        number: Any = lambda c, tissue: c
        with pytest.raises(TypeError, match="`couple` must return an energy"):
            evolve(Signals(None, [0.1], initial=[1.0], couple=number))

    def test_noise_in_growth_needs_a_dissipation(self):
        cycle = vx.growth.GrowAndDivide(0.1, 2.0)
        tissue = random_tissue(6, 0).with_capacity(8)
        with pytest.raises(ValueError, match="`dissipation` is missing"):
            vx.growth.grow(
                tissue, lambda cells: ENERGY, cycle, [0.0, 1.0], key=0, activity=ThermalNoise(0.1)
            )
