"""Time evolution of tissues."""

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
N_CELLS = 12


@functools.cache
def solid():
    """A relaxed tissue and its energy."""
    tissue, energy = relaxed(N_CELLS, 1, 3.5)
    return FIXED_TOPOLOGY(tissue, energy).tissue, energy


class TestDecayOfModes:
    """Small deviations decay mode by mode, at the rates of the eigenvalues of the Hessian over ζ."""

    @pytest.mark.thorough
    @pytest.mark.parametrize("order", [1, 2])
    def test_error_has_the_order_of_the_method(self, order):
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
            amplitude = np.sum((np.asarray(movie.tissue.vertices) - tissue.vertices) * mode) / size
            errors.append(abs(amplitude / np.exp(-values[number] * time / friction) - 1))
        # The number of steps is constant, so the error scales as the local error, of order p + 1.
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
    def test_energy_decreases_for_every_time_step(self, make):
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
        # After a time of 250 the tissue is at rest.
        rest = vx.equilibrate(movie.tissue, energy)
        np.testing.assert_allclose(movie.energy, rest.energy, rtol=1e-2)

    def check_messages_of_failures(self, movie):
        """The message of a batch describes the member that fails in the earliest frame."""
        of_frame = jnp.arange(6)
        failing = lambda first, result: jax.vmap(
            lambda frame: vx.RESULTS.where(frame < first, vx.RESULTS.successful, result)
        )(of_frame)
        slow = vx.RESULTS.nonlinear_max_steps_reached
        late = dataclasses.replace(movie, results=failing(4, slow), result=slow)
        early = dataclasses.replace(
            movie,
            times=10 + movie.times,
            results=failing(2, vx.RESULTS.overlap),
            result=vx.RESULTS.overlap,
            max_force=jnp.array(0.5),
        )
        broken = dataclasses.replace(
            late, max_force=jnp.array(jnp.nan), result=vx.RESULTS.nonfinite
        )
        with pytest.raises(RuntimeError, match=r"reached no equilibrium.*time 0.04, frame 4"):
            late.checked()
        message = r"overlap.*2 of 3 failed; before time 10.02, frame 2 of member 2; .*force 5.0e-01"
        with pytest.raises(RuntimeError, match=message):
            vx.fitting.stack([late, movie, early]).checked()
        jitted = eqx.filter_jit(lambda movie: movie.checked().energy)
        for failed, reason in (
            (late, "reached no equilibrium"),
            (early, "overlap, or its box folds"),
            (broken, "parameters of the energy must be finite"),
        ):
            with pytest.raises(RuntimeError, match=reason):
                jax.block_until_ready(jitted(failed))
        with pytest.raises(RuntimeError, match="broke down: its forces are not finite"):
            broken.checked()

    @pytest.mark.thorough
    def test_frames_transitions_and_flips_are_consistent(self):
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
        # A flip changes the cells of an edge; a second flip of the same edge may restore them.
        flipped = np.asarray(movie.flipped.sum(axis=1))
        assert (flipped <= movie.transitions).all()
        assert ((flipped - movie.transitions) % 2 == 0).all()
        assert len(movie.trajectory) == 6
        np.testing.assert_allclose(movie.trajectory.values["time"], movie.times)
        assert movie.converged
        assert movie.converged
        batch = vx.fitting.stack([movie, movie])
        self.check_messages_of_failures(movie)
        np.testing.assert_array_equal(batch.flipped, jnp.stack([movie.flipped] * 2))
        with pytest.raises(ValueError, match="one of a batch"):
            _ = batch.trajectory


class TestGradients:
    """Derivatives of the frames with respect to energy, friction, viscosity and initial vertices."""

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
        def cost(parameters, adjoint=vx.ImplicitDifferentiation(), order=1):
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
    def test_gradients_match_finite_differences(self, order):
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
    def test_equilibrium_propagation_equals_implicit_differentiation(self):
        parameters, cost = self.problem()
        slope = lambda adjoint: eqx.filter_jit(jax.grad(lambda p: cost(p, adjoint)))(parameters)
        by_propagation = slope(vx.EquilibriumPropagation(beta=1e-5))
        for one, other in zip(by_propagation, slope(vx.ImplicitDifferentiation()), strict=True):
            np.testing.assert_allclose(
                one, other, rtol=1e-4, atol=1e-5 * float(jnp.abs(other).max())
            )

    @pytest.mark.thorough
    def test_gradient_of_an_inverse_problem_away_from_rest(self):
        tissue, energy = solid()
        target = tissue.with_vertices(tissue.vertices + 0.05 * random_like(tissue.vertices, 2))
        problem = vx.InverseProblem(
            target,
            energy,
            vx.costs.VertexDistance(tissue),
            response=vx.Evolution(FRICTION, [0.0, 0.2], relaxation=FIXED_TOPOLOGY),
        )
        evaluation = eqx.filter_jit(lambda p: p.value_and_gradient(throw=False))(problem)
        direction = random_like(energy.target_shape_factor)
        evaluate = eqx.filter_jit(lambda p0: problem(ShapeFactorEnergy(p0), throw=False)[0])
        np.testing.assert_allclose(
            jnp.sum(evaluation.gradient.target_shape_factor * direction),
            central_difference(evaluate, energy.target_shape_factor, direction),
            rtol=1e-6,
        )


@pytest.mark.thorough
def test_stress_after_a_step_strain_of_the_hexagonal_lattice():
    # Tong et al. 2022 (doi:10.1371/journal.pcbi.1010135): the initial modulus is 3√3 K_P (1 - p0/c), the
    # final modulus 2/3 of it.
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


@pytest.mark.thorough
def test_pinned_vertices_follow_pins():
    tissue = vx.initialise.periodic_voronoi(9, key=4)
    mask = jnp.arange(18) < 2
    tissue = vx.Tissue(
        tissue.vertices, tissue.topology, tissue.boundary, tissue.softening, pinned=mask
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
def test_custom_energy_and_dissipation():
    class Ramp(eqx.Module):
        rate: jax.Array

        def __call__(self, time):
            return ShapeFactorEnergy(3.5 + self.rate * time)

    class CustomViscosity(vx.AbstractDissipation):
        strength: float

        def __call__(self, tissue, before, dt):
            return 0.5 * self.strength * jnp.sum((tissue.perimeters - before.perimeters) ** 2) / dt

    tissue, _ = solid()
    dissipation = FRICTION + CustomViscosity(0.3)
    relaxation = vx.Relaxation(transitions=None, contact_range=None)

    @eqx.filter_jit
    def end(rate, dissipation):
        return vx.evolve(
            tissue, Ramp(rate), dissipation, [0, 0.2, 0.4], relaxation=relaxation, throw=False
        ).tissue.perimeters

    rate = jnp.array(-0.2)
    built_in = end(rate, FRICTION + PerimeterViscosity(0.3))
    np.testing.assert_allclose(end(rate, dissipation), built_in, atol=1e-8)
    gradient = eqx.filter_jit(jax.grad(lambda r: end(r, dissipation).sum()))(rate)
    f = lambda r: end(r, dissipation).sum()
    np.testing.assert_allclose(gradient, central_difference(f, rate, jnp.array(1.0)), rtol=1e-5)


@pytest.mark.thorough
def test_other_values_need_no_recompilation():
    tissue, _ = solid()
    evolve_with = lambda friction, times: vx.evolve(
        tissue, ShapeFactorEnergy(3.3), SubstrateFriction(friction), times, relaxation=NO_CONTACT
    )
    first = evolve_with(1.0, [0.0, 0.1, 0.2])
    names: list[str] = []
    with counted_compilations(names):
        other = evolve_with(2.0, [0.0, 0.2, 0.4])
    assert not [name for name in names if "evolve" in name]
    # Times are proportional to the friction.
    np.testing.assert_allclose(first.tissue.vertices, other.tissue.vertices, atol=1e-9)


@pytest.mark.thorough
def test_free_cluster_relaxes_with_constant_centroid():
    tissue = cluster(9, 2)
    energy = AreaElasticity(2.0, 1.0) + LineTension(jnp.full(tissue.n_edges, 0.3))
    movie = vx.evolve(
        tissue, energy, FRICTION + AreaViscosity(0.5), [0.0, 1.0, 30.0], relaxation=NO_CONTACT
    )
    # The forces sum to zero, so the centroid does not move.
    np.testing.assert_allclose(
        movie.tissue.vertices.mean(axis=0), tissue.vertices.mean(axis=0), atol=1e-9
    )
    rest = vx.equilibrate(movie.tissue, energy, contact_range=None)
    np.testing.assert_allclose(movie.energy, rest.energy, rtol=1e-3)


class TestErrors:
    def test_times(self):
        tissue, energy = solid()
        for times, message in (
            ([0.0, 1.0, 1.0], r"must increase, but entry 1 is 1.0"),
            ([0.0], "two times or more"),
            ([0.0, np.nan], "finite"),
        ):
            with pytest.raises(ValueError, match=message):
                vx.evolve(tissue, energy, FRICTION, times)

    def test_error_lists_vertices_without_dissipation(self):
        tissue, energy = solid()
        partial_friction = SubstrateFriction(jnp.ones(24).at[jnp.array([3, 5])].set(0.0))
        with pytest.raises(ValueError, match=r"2 of 24 vertices \(3, 5\)"):
            vx.evolve(tissue, energy, partial_friction, [0.0, 1.0])

    def test_energy_function_must_return_an_energy(self, without_type_checks):
        tissue, _ = solid()
        with pytest.raises(TypeError, match="function of time that returns one, but returned"):
            vx.evolve(tissue, lambda time: 3.0 * time, FRICTION, [0.0, 1.0])  # pyright: ignore

    @pytest.mark.thorough
    def test_folded_box_raises(self):
        tissue, energy = solid()
        shrunk = lambda time: vx.Periodic(
            tissue.boundary.lattice @ jnp.diag(jnp.stack([1.0 - time, jnp.ones_like(time)]))
        )
        short_relaxation = vx.Relaxation(transitions=None, contact_range=None, max_steps=20)
        with pytest.raises(RuntimeError, match=r"its box folds.*time 1.5, frame 1"):
            vx.evolve(
                tissue, energy, FRICTION, [0.0, 1.5], boundary=shrunk, relaxation=short_relaxation
            )

    def test_drive_of_another_activity_or_tissue_raises(self):
        tissue, energy = solid()
        noise, moving = vx.activities.ThermalNoise(0.1), vx.activities.SelfPropulsion(0.1)
        other = vx.initialise.periodic_voronoi(9, key=0)
        for activity, initial in ((noise, tissue), (moving, other)):
            drive = (activity.init(initial, jax.random.key(0)), jax.random.key(1))
            with pytest.raises(ValueError, match="`drive` does not go with this"):
                vx.evolve(tissue, energy, FRICTION, [0, 1], activity=moving, drive=drive)

    def test_settings(self, without_type_checks):
        class CustomDissipation(vx.AbstractDissipation):
            def __call__(self, tissue, before, dt):
                return jnp.sum((tissue.vertices - before.vertices) ** 2) / dt

        with pytest.raises(ValueError, match="sum of squares"):
            vx.Evolution(CustomDissipation(), [0.0, 1.0], order=2)
        with pytest.raises(ValueError, match="`order` must be one of 1, 2"):
            vx.Evolution(FRICTION, [0.0, 1.0], order=3)
        with pytest.raises(ValueError, match="`substeps` must be at least 1"):
            vx.Evolution(FRICTION, [0.0, 1.0], substeps=0)
        with pytest.raises(TypeError, match="`dissipation`"):
            vx.Evolution(1.0, [0.0, 1.0])  # pyright: ignore[reportArgumentType]
        with pytest.raises(TypeError, match="`boundary` must be a function of time"):
            vx.Evolution(FRICTION, [0.0, 1.0], boundary=vx.Free())  # pyright: ignore[reportArgumentType]

    def test_arguments_incompatible_with_the_tissue(self, without_type_checks):
        tissue, energy = solid()
        constant_positions = lambda time: tissue.vertices
        with pytest.raises(ValueError, match=r"`pins` .*the tissue has none"):
            vx.evolve(tissue, energy, FRICTION, [0.0, 1.0], pins=constant_positions)
        mask = jnp.arange(tissue.n_vertices) < 2
        pinned_tissue = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary, pinned=mask)
        with pytest.raises(ValueError, match="`pins` must return one position for each vertex"):
            vx.evolve(
                pinned_tissue,
                energy,
                FRICTION,
                [0.0, 1.0],
                pins=lambda time: constant_positions(time)[:3],
            )
        with pytest.raises(TypeError, match="`energy` must be an energy"):
            vx.evolve(tissue, 3.0, FRICTION, [0.0, 1.0])  # pyright: ignore[reportArgumentType]
        not_a_boundary = lambda time: tissue.boundary.lattice
        with pytest.raises(TypeError, match="must be of the class Periodic"):
            vx.evolve(tissue, energy, FRICTION, [0.0, 1.0], boundary=not_a_boundary)  # pyright: ignore[reportArgumentType]

    @pytest.mark.thorough
    def test_step_that_does_not_converge_raises(self):
        tissue = random_tissue(N_CELLS, 3)
        with pytest.raises(RuntimeError, match=r"time 0\.5, frame 1"):
            vx.evolve(
                tissue,
                ShapeFactorEnergy(3.5),
                FRICTION,
                [0.0, 0.5, 1.0],
                relaxation=vx.Relaxation(transitions=None, contact_range=None, max_steps=1),
            )
