"""Tissues that move in time."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import (
    FIXED_TOPOLOGY,
    NO_CONTACT,
    central_difference,
    counted_compilations,
    dense_hessian,
    fine_difference,
    hexagon_index,
    random_like,
    random_tissue,
    relaxed,
)

import vertax as vx
from vertax.dissipations import AreaViscosity, PerimeterViscosity, SubstrateFriction
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity, ShapeFactorEnergy

FRICTION = SubstrateFriction(1.0)
CELLS = 12


@functools.cache
def solid():
    """A relaxed tissue and its energy."""
    tissue, energy = relaxed(CELLS, 1, 3.5)
    return FIXED_TOPOLOGY(tissue, energy).tissue, energy


class TestDecay:
    """Small deviations decay mode by mode, at the rates of the eigenvalues of the Hessian over ζ."""

    @pytest.mark.parametrize("order", [1, 2])
    def test_it_has_the_order_of_the_method(self, order):
        tissue, energy = solid()
        values, modes = np.linalg.eigh(dense_hessian(tissue, energy))
        number, size, friction = 20, 1e-5, 2.0
        mode = modes[:, number].reshape(-1, 2)
        start = tissue.with_vertices(tissue.vertices + size * mode)
        relaxation = vx.Relaxation(transitions=None, contact_range=None, tolerance=1e-11)
        errors = []
        for time in (0.4, 0.2, 0.1):
            movie = vx.evolve(
                start,
                energy,
                SubstrateFriction(friction),
                [0.0, time],
                substeps=8,
                order=order,
                relaxation=relaxation,
            )
            left = np.sum((np.asarray(movie.tissue.vertices) - tissue.vertices) * mode) / size
            errors.append(abs(left / np.exp(-values[number] * time / friction) - 1))
        # As many steps of half the length: an error in each of one order more.
        np.testing.assert_allclose(np.log2(errors[0] / errors[1]), order + 1, atol=0.25)
        np.testing.assert_allclose(np.log2(errors[1] / errors[2]), order + 1, atol=0.15)
        assert errors[0] < (0.1 if order == 1 else 2e-3)


class TestWithoutActivity:
    @pytest.mark.thorough
    @pytest.mark.parametrize(
        "make",
        [random_tissue, pytest.param(cluster, marks=pytest.mark.slow)],
        ids=["periodic", "free"],
    )
    def test_the_energy_never_rises_whatever_the_step(self, make):
        tissue = make(9, 4)
        energy = ShapeFactorEnergy(jnp.linspace(3.2, 3.6, 9))
        num_t1 = 0
        for step in (0.01, 0.3, 50.0):
            movie = vx.evolve(tissue, energy, FRICTION, step * jnp.arange(6))
            assert (jnp.diff(movie.energies) <= 1e-12).all()
            assert movie.energies[-1] < movie.energies[0]
            assert movie.num_t1 == movie.transitions.sum()
            num_t1 += int(movie.num_t1)
        assert num_t1 > 0
        # After so long it is at rest.
        rest = vx.equilibrate(movie.tissue, energy)
        np.testing.assert_allclose(movie.energy, rest.energy, rtol=1e-2)

    def check_messages_of_failures(self, movie):
        """The message of a batch is that of the member which fails in the earliest frame."""
        of_frame = jnp.arange(6)
        late = dataclasses.replace(
            movie, sound=of_frame < 4, result=vx.RESULTS.nonlinear_max_steps_reached
        )
        early = dataclasses.replace(
            movie,
            times=10 + movie.times,
            sound=of_frame < 2,
            valid=jnp.array(False),
            max_force=jnp.array(0.5),
        )
        broken = dataclasses.replace(
            late, max_force=jnp.array(jnp.nan), result=vx.RESULTS.nonfinite
        )
        with pytest.raises(RuntimeError, match=r"time 0.04 \(frame 4\) a step in time did not"):
            late.checked()
        message = (
            r"time 10.02 \(frame 2\) of member 2 \(2 of 3 failed\) cells overlap.*force 5.0e-01"
        )
        with pytest.raises(RuntimeError, match=message):
            vx.fitting.stack([late, movie, early]).checked()
        jitted = eqx.filter_jit(lambda movie: movie.checked().energy)
        for failed, reason in (
            (late, "A step in time did not converge"),
            (early, "cells overlap, or the box folds"),
            (broken, "parameters of the energy must be finite"),
        ):
            with pytest.raises(RuntimeError, match=reason):
                jax.block_until_ready(jitted(failed))
        with pytest.raises(RuntimeError, match="broke down: its forces are not finite"):
            broken.checked()

    def test_frames_say_what_happened(self):
        tissue = random_tissue(9, 4)
        energy = ShapeFactorEnergy(jnp.linspace(3.2, 3.6, 9))
        movie = vx.evolve(tissue, energy, FRICTION, 0.01 * jnp.arange(6))
        first, last = (
            jax.tree.map(lambda x, i=i: x[i] if eqx.is_array(x) else x, movie.frames)
            for i in (0, -1)
        )
        np.testing.assert_array_equal(first.vertices, tissue.vertices)
        np.testing.assert_array_equal(last.vertices, movie.tissue.vertices)
        assert movie.frames.vertices.shape == (6, 18, 2)
        # An edge that flipped lies between other cells; one that did twice may be back.
        flipped = np.asarray(movie.flipped.sum(axis=1))
        assert (flipped <= movie.transitions).all()
        assert ((flipped - movie.transitions) % 2 == 0).all()
        assert len(movie.trajectory) == 6
        np.testing.assert_allclose(movie.trajectory.values["time"], movie.times)
        assert movie.converged
        assert movie.sound.all()
        batch = vx.fitting.stack([movie, movie])
        self.check_messages_of_failures(movie)
        np.testing.assert_array_equal(batch.flipped, jnp.stack([movie.flipped] * 2))
        with pytest.raises(ValueError, match="a batch of"):
            _ = batch.trajectory


class TestGradients:
    """Of what the last frame is with respect to all that it depends on."""

    @staticmethod
    def problem():
        tissue, energy = solid()
        start = tissue.with_vertices(tissue.vertices + 0.02 * random_like(tissue.vertices, 7))
        weights = random_like(tissue.vertices, 8)
        parameters = (
            energy.target_shape_factor,
            jnp.linspace(0.5, 1.5, 24),
            start.vertices,
            jnp.array(0.3),
        )

        @eqx.filter_jit
        def cost(parameters, adjoint=None, order=1):
            targets, friction, vertices, viscosity = parameters
            movie = vx.evolve(
                start.with_vertices(vertices),
                ShapeFactorEnergy(targets),
                SubstrateFriction(friction) + PerimeterViscosity(viscosity),
                [0.0, 0.1, 0.4],
                substeps=2,
                order=order,
                relaxation=dataclasses.replace(FIXED_TOPOLOGY, tolerance=1e-12),
                adjoint=adjoint,
                throw=False,
            )
            return jnp.sum(weights * movie.frames.vertices[1:] ** 2)

        return parameters, cost

    @pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
    def test_they_match_finite_differences(self, order):
        parameters, cost = self.problem()
        gradient = eqx.filter_jit(jax.grad(lambda p: cost(p, order=order)))(parameters)
        for number, part in enumerate(parameters):
            direction = jax.tree.map(jnp.zeros_like, list(parameters))
            direction[number] = random_like(part, 5 + number)
            slope = sum(jnp.sum(g * d) for g, d in zip(gradient, direction, strict=True))
            f = lambda p: cost(p, order=order)
            expected = fine_difference(f, parameters, tuple(direction))
            np.testing.assert_allclose(slope, expected, rtol=1e-6)

    @pytest.mark.thorough
    def test_equilibrium_propagation_agrees_step_by_step(self):
        parameters, cost = self.problem()
        slope = lambda adjoint: eqx.filter_jit(jax.grad(lambda p: cost(p, adjoint)))(parameters)
        by_propagation = slope(vx.EquilibriumPropagation(beta=1e-5))
        for one, other in zip(by_propagation, slope(None), strict=True):
            np.testing.assert_allclose(
                one, other, rtol=1e-4, atol=1e-5 * float(jnp.abs(other).max())
            )

    @pytest.mark.thorough
    def test_an_inverse_problem_of_a_tissue_that_is_not_at_rest(self):
        tissue, energy = solid()
        target = tissue.with_vertices(tissue.vertices + 0.05 * random_like(tissue.vertices, 2))
        problem = vx.InverseProblem(
            target,
            energy,
            vx.costs.VertexDistance(tissue),
            response=vx.Evolution(FRICTION, [0.0, 0.2], relaxation=FIXED_TOPOLOGY),
        )
        found = eqx.filter_jit(lambda p: p.value_and_gradient(throw=False))(problem)
        direction = random_like(energy.target_shape_factor)
        evaluate = eqx.filter_jit(lambda p0: problem(ShapeFactorEnergy(p0), throw=False)[0])
        np.testing.assert_allclose(
            jnp.sum(found.gradient.target_shape_factor * direction),
            central_difference(evaluate, energy.target_shape_factor, direction),
            rtol=1e-6,
        )


def test_a_step_strain_of_the_hexagonal_lattice():
    # Tong et al. 2022 (doi:10.1371/journal.pcbi.1010135): at first 3√3 K_P (1 - p0/c), in the end two thirds
    # of that.
    stiffness, p0, strain = 0.7, 3.4, 1e-4
    tissue = vx.initialise.hexagonal(2, 2)
    tissue = eqx.tree_at(lambda t: t.softening, tissue, 0 * tissue.softening)
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(stiffness, p0)
    lattice = tissue.boundary.lattice
    sheared = lambda by: vx.Periodic(lattice @ jnp.array([[1.0, 0.0], [by, 1.0]]))
    movie = vx.evolve(
        tissue,
        energy,
        FRICTION,
        [0.0, 1e-7, 40.0],
        substeps=4,
        boundary=lambda time: sheared(strain),
        relaxation=FIXED_TOPOLOGY,
    )

    def stress(frame):
        pulled = lambda by: energy(
            frame.carried(vx.Periodic(frame.boundary.lattice @ jnp.array([[1.0, 0.0], [by, 1.0]])))
        )
        return jax.grad(pulled)(0.0) / tissue.areas.sum()

    arrays, static = eqx.partition(movie.frames, eqx.is_array)
    stresses = jax.vmap(lambda a: stress(eqx.combine(a, static)))(arrays)
    unit = stiffness * (1 - p0 / hexagon_index()) * strain
    np.testing.assert_allclose(stresses[1], 3 * 3**0.5 * unit, rtol=1e-3)
    np.testing.assert_allclose(stresses[2], 2 * 3**0.5 * unit, rtol=1e-3)


def test_pinned_vertices_go_where_they_are_told():
    tissue = vx.initialise.periodic_voronoi(9, key=4)
    held = jnp.arange(18) < 2
    tissue = vx.Tissue(
        tissue.vertices, tissue.topology, tissue.boundary, tissue.softening, pinned=held
    )
    velocity = jnp.array([0.05, 0.0])
    movie = vx.evolve(
        tissue,
        ShapeFactorEnergy(3.5),
        FRICTION,
        [0.0, 0.5, 1.0],
        pins=lambda time: tissue.vertices + time * velocity,
        relaxation=FIXED_TOPOLOGY,
    )
    moved = movie.frames.vertices - tissue.vertices
    np.testing.assert_allclose(moved[:, :2], movie.times[:, None, None] * jnp.stack([velocity] * 2))


@pytest.mark.thorough
def test_an_energy_and_a_dissipation_of_ones_own():
    class Ramp(eqx.Module):
        rate: jax.Array

        def __call__(self, time):
            return ShapeFactorEnergy(3.5 + self.rate * time)

    class Reluctance(vx.AbstractDissipation):
        strength: float

        def __call__(self, tissue, before, dt):
            return 0.5 * self.strength * jnp.sum((tissue.perimeters - before.perimeters) ** 2) / dt

    tissue, _ = solid()
    dissipation = FRICTION + Reluctance(0.3)
    relaxation = vx.Relaxation(transitions=None, contact_range=None)

    @eqx.filter_jit
    def end(rate, dissipation):
        return vx.evolve(
            tissue, Ramp(rate), dissipation, [0, 0.2, 0.4], relaxation=relaxation, throw=False
        ).tissue.perimeters

    rate = jnp.array(-0.2)
    shipped = end(rate, FRICTION + PerimeterViscosity(0.3))
    np.testing.assert_allclose(end(rate, dissipation), shipped, atol=1e-8)
    gradient = eqx.filter_jit(jax.grad(lambda r: end(r, dissipation).sum()))(rate)
    f = lambda r: end(r, dissipation).sum()
    np.testing.assert_allclose(gradient, central_difference(f, rate, jnp.array(1.0)), rtol=1e-5)


def test_other_numbers_compile_nothing_and_batches_agree():
    tissue, _ = solid()
    go = lambda friction, times: vx.evolve(
        tissue, ShapeFactorEnergy(3.3), SubstrateFriction(friction), times, relaxation=NO_CONTACT
    )
    first = go(1.0, [0.0, 0.1, 0.2])
    names: list[str] = []
    with counted_compilations(names):
        other = go(2.0, [0.0, 0.2, 0.4])
    assert not [name for name in names if "evolve" in name]
    # Twice the friction takes twice as long.
    np.testing.assert_allclose(first.tissue.vertices, other.tissue.vertices, atol=1e-9)


@pytest.mark.thorough
def test_a_cluster_with_arcs_rounds_up_and_stays_where_it_is():
    tissue = cluster(9, 2)
    energy = AreaElasticity(2.0, 1.0) + LineTension(jnp.full(tissue.n_edges, 0.3))
    movie = vx.evolve(
        tissue, energy, FRICTION + AreaViscosity(0.5), [0.0, 1.0, 30.0], relaxation=NO_CONTACT
    )
    # Forces that add up to zero move no centre of friction.
    np.testing.assert_allclose(
        movie.tissue.vertices.mean(axis=0), tissue.vertices.mean(axis=0), atol=1e-9
    )
    rest = vx.equilibrate(movie.tissue, energy, contact_range=None)
    np.testing.assert_allclose(movie.energy, rest.energy, rtol=1e-3)


class TestBadInput:
    def test_times(self):
        tissue, energy = solid()
        for times, message in (
            ([0.0, 1.0, 1.0], r"must increase, but entry 1 is 1.0"),
            ([0.0], "two times or more"),
            ([0.0, np.nan], "finite"),
        ):
            with pytest.raises(ValueError, match=message):
                vx.evolve(tissue, energy, FRICTION, times)

    def test_vertices_that_nothing_holds_back_are_named(self):
        tissue, energy = solid()
        some = SubstrateFriction(jnp.ones(24).at[jnp.array([3, 5])].set(0.0))
        with pytest.raises(ValueError, match=r"2 of 24 vertices \(3, 5\)"):
            vx.evolve(tissue, energy, some, [0.0, 1.0])

    def test_an_energy_that_is_none(self, without_type_checks):
        tissue, _ = solid()
        with pytest.raises(TypeError, match="function of time that returns one, but returned"):
            vx.evolve(tissue, lambda time: 3.0 * time, FRICTION, [0.0, 1.0])  # pyright: ignore

    def test_a_box_that_folds(self):
        tissue, energy = solid()
        shrunk = lambda time: vx.Periodic(
            tissue.boundary.lattice @ jnp.diag(jnp.stack([1.0 - time, jnp.ones_like(time)]))
        )
        few = vx.Relaxation(transitions=None, contact_range=None, max_steps=20)
        with pytest.raises(RuntimeError, match=r"time 1.5 \(frame 1\) .*the box folds"):
            vx.evolve(tissue, energy, FRICTION, [0.0, 1.5], boundary=shrunk, relaxation=few)

    def test_a_drive_of_another_activity_or_tissue(self):
        tissue, energy = solid()
        noise, moving = vx.activities.ThermalNoise(0.1), vx.activities.SelfPropulsion(0.1)
        other = vx.initialise.periodic_voronoi(9, key=0)
        for activity, place in ((noise, tissue), (moving, other)):
            drive = (activity.init(place, jax.random.key(0)), jax.random.key(1))
            with pytest.raises(ValueError, match="`drive` does not go with this"):
                vx.evolve(tissue, energy, FRICTION, [0, 1], activity=moving, drive=drive)

    def test_settings(self, without_type_checks):
        class Own(vx.AbstractDissipation):
            def __call__(self, tissue, before, dt):
                return jnp.sum((tissue.vertices - before.vertices) ** 2) / dt

        with pytest.raises(ValueError, match="sum of squares"):
            vx.Evolution(Own(), [0.0, 1.0], order=2)
        with pytest.raises(ValueError, match="`order` must be 1 or 2"):
            vx.Evolution(FRICTION, [0.0, 1.0], order=3)
        with pytest.raises(ValueError, match="`substeps` must be at least 1"):
            vx.Evolution(FRICTION, [0.0, 1.0], substeps=0)
        with pytest.raises(TypeError, match="`dissipation`"):
            vx.Evolution(1.0, [0.0, 1.0])  # pyright: ignore[reportArgumentType]
        with pytest.raises(TypeError, match="`boundary` must be a function of time"):
            vx.Evolution(FRICTION, [0.0, 1.0], boundary=vx.Free())  # pyright: ignore[reportArgumentType]

    def test_what_does_not_go_with_the_tissue(self, without_type_checks):
        tissue, energy = solid()
        still = lambda time: tissue.vertices
        with pytest.raises(ValueError, match=r"`pins` .*the tissue has none"):
            vx.evolve(tissue, energy, FRICTION, [0.0, 1.0], pins=still)
        two = jnp.arange(tissue.n_vertices) < 2
        held = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, pinned=two)
        with pytest.raises(ValueError, match="`pins` must return one position for each vertex"):
            vx.evolve(held, energy, FRICTION, [0.0, 1.0], pins=lambda time: still(time)[:3])
        with pytest.raises(TypeError, match="`energy` must be an energy"):
            vx.evolve(tissue, 3.0, FRICTION, [0.0, 1.0])  # pyright: ignore[reportArgumentType]
        flat = lambda time: tissue.boundary.lattice
        with pytest.raises(TypeError, match="must be of the class Periodic"):
            vx.evolve(tissue, energy, FRICTION, [0.0, 1.0], boundary=flat)  # pyright: ignore[reportArgumentType]

    def test_a_step_that_does_not_converge_is_refused(self):
        tissue = random_tissue(CELLS, 3)
        with pytest.raises(RuntimeError, match=r"time 0\.5 \(frame 1\)"):
            vx.evolve(
                tissue,
                ShapeFactorEnergy(3.5),
                FRICTION,
                [0.0, 0.5, 1.0],
                relaxation=vx.Relaxation(transitions=None, contact_range=None, max_steps=1),
            )
