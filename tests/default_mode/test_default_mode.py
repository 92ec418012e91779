"""The main functions as users run JAX: in float32, with the normal optimisation of XLA."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from free_helpers import cluster
from helpers import (
    ADAM,
    FIXED_TOPOLOGY,
    LEAST_SQUARES,
    central_difference,
    random_tissue,
)
from movie_helpers import rows_of, table_of

import vertax as vx
from vertax import mechanics
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity, ShapeFactorEnergy

N = 12
FRICTION = vx.dissipations.SubstrateFriction(1.0)
TRUTH = np.asarray(3.65 + 0.1 * np.sin(np.arange(N)), np.float32)


def floats(tree) -> set[str]:
    """The data types of all floating-point arrays of a pytree."""
    return {str(x.dtype) for x in jax.tree.leaves(tree) if eqx.is_inexact_array(x)}


@pytest.fixture(scope="module")
def rest():
    """A tissue at rest, and its energy."""
    energy = ShapeFactorEnergy(jnp.asarray(TRUTH))
    return FIXED_TOPOLOGY(random_tissue(N, 1, lloyd_steps=2), energy).tissue, energy


@pytest.fixture(scope="module")
def hexagons():
    energy = AreaElasticity(1.0, 1.0) + PerimeterElasticity(1.0, 3.4)
    return vx.initialise.hexagonal(4, 4), energy


class TestEquilibria:
    @pytest.mark.parametrize("spare", [0, pytest.param(4, marks=pytest.mark.thorough)])
    def test_default_relaxation_reaches_rest_without_overlaps(self, spare):
        tissue = random_tissue(N, 3)
        tissue = tissue.with_capacity(N + spare) if spare else tissue
        equilibrium = vx.equilibrate(tissue, ShapeFactorEnergy(3.7))
        assert equilibrium.converged
        assert equilibrium.num_t1 > 0
        assert not equilibrium.tissue.overlaps.any
        assert floats(equilibrium) == {"float32"}

    @pytest.mark.thorough
    def test_free_tissue_with_arcs_reaches_rest(self):
        tissue = cluster(6, 1)
        energy = AreaElasticity(5.0, 1.0) + LineTension(0.5)
        equilibrium = FIXED_TOPOLOGY(tissue, energy)
        assert equilibrium.converged
        assert floats(equilibrium) == {"float32"}

    @pytest.mark.parametrize(
        "solver",
        [
            pytest.param(vx.solvers.LBFGS(), id="lbfgs"),
            pytest.param(vx.solvers.FIRE(), id="fire", marks=pytest.mark.thorough),
        ],
    )
    @pytest.mark.thorough
    def test_other_solvers_reach_the_same_energy(self, rest, solver):
        tissue, energy = rest
        shaken = tissue.with_vertices(tissue.vertices.at[0].add(0.05))
        relaxation = vx.Relaxation(solver=solver, transitions=None, contact_range=None)
        equilibrium = relaxation(shaken, energy)
        assert equilibrium.converged
        assert float(equilibrium.energy) == pytest.approx(float(energy(tissue)), abs=1e-4)

    @pytest.mark.thorough
    def test_an_energy_without_minimum_ends_the_search(self):
        tissue = random_tissue(9, 0)
        energy = LineTension(jnp.full(tissue.n_edges, -1.0))
        equilibrium = FIXED_TOPOLOGY(tissue, energy, throw=False)
        assert equilibrium.result == vx.RESULTS.no_progress
        assert equilibrium.num_steps <= 400


MOMENTUM = vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))
ADJOINTS = {
    "implicit": vx.ImplicitDifferentiation(),
    "sensitivity": vx.ImplicitDifferentiation(mode="sensitivity"),
    "propagation": vx.EquilibriumPropagation(),
    "automatic": vx.AutomaticDifferentiation(),
}


@pytest.fixture(scope="module")
def difference(rest):
    """A loss of the shape factors, a direction, and the finite difference along it."""
    tissue, _ = rest
    target = tissue.with_vertices(tissue.vertices + 0.05 * jnp.sin(7 * tissue.vertices))
    cost = 10 * vx.costs.VertexDistance(target)
    direction = jnp.cos(jnp.arange(N, dtype=jnp.float32))

    @eqx.filter_jit
    def loss(p0, adjoint, relaxation):
        energy = ShapeFactorEnergy(p0)
        return cost(relaxation(tissue, energy, adjoint=adjoint).tissue, energy)

    at = lambda p0: loss(p0, ADJOINTS["implicit"], FIXED_TOPOLOGY)
    return loss, direction, central_difference(at, jnp.asarray(TRUTH), direction, 1e-2)


class TestGradients:
    @pytest.mark.parametrize(
        "name",
        [
            pytest.param(name, marks=() if name == "implicit" else pytest.mark.thorough)
            for name in ADJOINTS
        ],
    )
    def test_gradient_matches_finite_differences(self, difference, name):
        loss, direction, expected = difference
        relaxation = FIXED_TOPOLOGY
        if name == "automatic":
            relaxation = vx.Relaxation(
                solver=MOMENTUM, transitions=None, contact_range=None, max_steps=20_000
            )
        gradient = jax.grad(lambda p0: loss(p0, ADJOINTS[name], relaxation))(jnp.asarray(TRUTH))
        assert gradient.dtype == jnp.float32
        # Rounding adds up over thousands of unrolled steps.
        accuracy = 0.15 if name == "automatic" else 0.03
        assert float(gradient @ direction) == pytest.approx(float(expected), rel=accuracy)

    @pytest.mark.thorough
    def test_gradients_of_a_batch_are_those_of_its_members(self, difference):
        loss, *_ = difference
        slope = jax.grad(lambda p0: loss(p0, ADJOINTS["implicit"], FIXED_TOPOLOGY))
        batch = jnp.stack([jnp.asarray(TRUTH), jnp.full(N, 3.6)])
        together = jax.vmap(slope)(batch)
        for one, p0 in zip(together, batch, strict=True):
            np.testing.assert_allclose(one, slope(p0), atol=2e-3 * float(jnp.abs(one).max()))


@pytest.fixture(scope="module")
def problem(rest):
    target, _ = rest
    guess = ShapeFactorEnergy(jnp.full(N, 3.65))
    start = FIXED_TOPOLOGY(target, guess).tissue
    cost = vx.costs.VertexDistance(target)
    return vx.InverseProblem(start, guess, cost, response=FIXED_TOPOLOGY)


class TestFits:
    @pytest.mark.parametrize(
        ("optimiser", "epochs"),
        [
            pytest.param(ADAM, 80, id="adam"),
            pytest.param(LEAST_SQUARES, 10, id="least_squares", marks=pytest.mark.thorough),
        ],
    )
    def test_fit_recovers_shape_factors(self, problem, optimiser, epochs):
        fit = vx.fit(problem, optimiser, epochs, progress=False)
        assert floats(fit.energy) == {"float32"}
        assert fit.history.converged.all()
        np.testing.assert_allclose(fit.energy.target_shape_factor, TRUTH, atol=0.01)


class TestMechanics:
    @pytest.mark.thorough
    def test_moduli_of_hexagons_have_their_closed_forms(self, hexagons):
        tissue, energy = hexagons
        c, p0 = float(jnp.sqrt(8 * jnp.sqrt(3.0))), 3.4
        shear = float(mechanics.shear_modulus(tissue, energy))
        assert shear == pytest.approx(c * (c - p0) / 4, rel=5e-3)
        bulk = float(mechanics.bulk_modulus(tissue, energy))
        assert bulk == pytest.approx(1 + c * p0 / 4, rel=5e-3)

    def test_zero_modes_are_translations(self, rest):
        assert int(mechanics.zero_modes(*rest)) == 2

    def test_zero_modes_of_a_free_tissue_are_rigid_motions(self):
        energy = AreaElasticity(5.0, 1.0) + LineTension(0.5)
        tissue = FIXED_TOPOLOGY(cluster(6, 1), energy).tissue
        assert int(mechanics.zero_modes(tissue, energy)) == 3

    def test_spectrum_is_that_of_the_dense_hessian(self, rest):
        tissue, energy = rest
        at = lambda x: energy(tissue.with_vertices(x.reshape(-1, 2)))
        matrix = jax.jit(jax.hessian(at))(tissue.vertices.ravel())
        expected = np.linalg.eigvalsh(np.asarray(matrix, float))
        np.testing.assert_allclose(mechanics.spectrum(tissue, energy), expected, atol=1e-3)

    def test_stress_is_the_derivative_of_the_energy_by_strain(self, rest):
        tissue, energy = rest

        @jax.jit
        def strained(strain):
            turn = jnp.eye(2) + strain
            boundary = eqx.tree_at(
                lambda b: b.lattice, tissue.boundary, tissue.boundary.lattice @ turn
            )
            moved = tissue.with_vertices(tissue.vertices @ turn)
            return energy(eqx.tree_at(lambda t: t.boundary, moved, boundary))

        unit = jnp.zeros((2, 2)).at[0, 0].set(1.0)
        slope = central_difference(strained, jnp.zeros((2, 2)), unit, 1e-2) / N
        assert float(mechanics.stress(tissue, energy)[0, 0]) == pytest.approx(slope, abs=2e-3)


class TestDynamics:
    def test_energy_decreases_with_friction(self):
        times = jnp.linspace(0, 5, 6)
        relaxation = vx.Relaxation(contact_range=None)
        movie = vx.evolve(
            random_tissue(N, 4), ShapeFactorEnergy(3.6), FRICTION, times, relaxation=relaxation
        )
        assert floats(movie) == {"float32"}
        assert (jnp.diff(movie.energies) < 1e-5).all()
        assert movie.energies[-1] < 0.9 * movie.energies[0]

    @pytest.mark.thorough
    def test_gradient_of_an_evolution_matches_finite_differences(self, rest):
        tissue, _ = rest

        @jax.jit
        def loss(p0):
            energy = ShapeFactorEnergy(p0)
            end = vx.evolve(
                tissue, energy, FRICTION, jnp.array([0.0, 0.5]), relaxation=FIXED_TOPOLOGY
            )
            return jnp.sum(end.tissue.perimeters**2)

        p0 = jnp.float32(3.8)
        expected = central_difference(loss, p0, jnp.float32(1.0), 2e-2)
        assert float(jax.grad(loss)(p0)) == pytest.approx(float(expected), rel=0.03)


class TestInputAndOutput:
    def test_saved_tissue_is_the_same(self, rest, tmp_path):
        tissue, _ = rest
        vx.save(tmp_path / "tissue.npz", tissue)
        loaded = vx.load(tmp_path / "tissue.npz", vx.Tissue)
        assert loaded.vertices.dtype == jnp.float32
        np.testing.assert_array_equal(loaded.vertices, tissue.vertices)

    def test_saved_energy_is_the_same(self, rest, tmp_path):
        vx.save(tmp_path / "energy.npz", rest[1])
        loaded = vx.load(tmp_path / "energy.npz", vx.AbstractEnergy)
        np.testing.assert_array_equal(loaded.target_shape_factor, TRUTH)

    def test_tables_return_the_same_tissue(self, rest):
        tissue, _ = rest
        again = vx.io.from_tables(vx.io.to_tables(tissue))
        np.testing.assert_allclose(np.sort(again.areas), np.sort(tissue.areas), atol=1e-5)

    @pytest.mark.thorough
    def test_tensions_of_a_foam_are_recovered(self):
        energy = AreaElasticity(20.0, jnp.linspace(0.9, 1.2, 14))
        tissue = cluster(14, 3, lloyd_steps=3, inner_arcs=True)
        tension = 1 + 0.3 * jnp.sin(jnp.arange(tissue.n_edges))
        foam = FIXED_TOPOLOGY(tissue, energy + LineTension(tension)).tissue
        inferred = vx.tensions.infer_tensions(foam)
        assert inferred.determined.sum() > 10
        true = np.asarray(tension)[inferred.determined]
        estimate = inferred.tensions[inferred.determined]
        np.testing.assert_allclose(estimate / estimate.mean(), true / true.mean(), rtol=0.05)


class TestSurfacesSignalsAndMovies:
    @pytest.mark.thorough
    def test_a_tissue_on_a_tilted_plane_is_the_stretched_tissue(self):
        flat, energy = vx.initialise.free_voronoi(6, key=0), ShapeFactorEnergy(3.6)
        heights = np.broadcast_to(0.75 * 0.5 * np.arange(16), (16, 16))
        slope = vx.surfaces.HeightMap(heights, 0.5, origin=(-4.0, -4.0))
        chart = flat.vertices / jnp.array([1.25, 1.0])
        tilted = vx.Tissue(chart, flat.topology, flat.boundary, surface=slope)
        plane = vx.Tissue(flat.vertices, flat.topology, flat.boundary)
        ends = [FIXED_TOPOLOGY(t.with_capacity(9), energy) for t in (tilted, plane)]
        assert floats(ends[0]) == {"float32"}
        np.testing.assert_allclose(ends[0].energy, ends[1].energy, atol=1e-5)
        np.testing.assert_allclose(ends[0].tissue.areas, ends[1].tissue.areas, atol=2e-3)

    def test_tensions_of_a_mask_with_heights(self):
        row = np.arange(200)[:, None] // 40
        bricks = 5 * row + (np.arange(200) + 20 * (row % 2)) // 40 % 5 + 1
        heights = np.broadcast_to(0.75 * np.arange(200), (200, 200))
        inferred = vx.tensions.infer_tensions(bricks, height=heights)
        assert inferred.curved is not None
        np.testing.assert_allclose(inferred.curved.areas / inferred.tissue.areas, 1.25, rtol=1e-4)
        assert np.isfinite(inferred.tensions[inferred.determined]).sum() > 10

    @pytest.mark.thorough
    def test_amounts_of_signals_are_conserved(self, rest):
        tissue, _ = rest
        start = np.pad(1 + np.sin(np.arange(N)), (0, 2))[None]
        movie = vx.evolve(
            tissue.with_capacity(N + 2),
            ShapeFactorEnergy(3.7),
            FRICTION,
            jnp.linspace(0, 1, 3),
            activity=vx.signals.Signals(None, [0.5], initial=start),
            relaxation=FIXED_TOPOLOGY,
        )
        before, after = (np.asarray(movie.signals)[k, 0] for k in (0, -1))
        amount = np.sum(before[:N] * tissue.areas)
        np.testing.assert_allclose(np.sum(after * movie.tissue.areas), amount, rtol=1e-5)
        assert np.ptp(after[:N]) < 0.8 * np.ptp(before[:N])

    @pytest.mark.thorough
    def test_a_movie_is_read_from_its_table(self, rest):
        moved = rest[0].with_vertices(rest[0].vertices + 0.4)  # corners leave the box
        table = table_of(rows_of(rest[0], 0) + rows_of(moved, 1))
        movie = vx.inference.movie_from_table(table, box=moved.boundary.lattice)
        np.testing.assert_allclose(movie.frame(1).areas, moved.areas, rtol=1e-5)


class TestTransitions:
    @pytest.mark.thorough
    def test_division_and_removal_keep_areas(self):
        tissue = random_tissue(N, 1).with_capacity(N + 1)
        divided = vx.transitions.divide(tissue, 2).tissue
        assert int(divided.alive.sum()) == N + 1
        assert float(divided.areas.sum()) == pytest.approx(N, rel=1e-5)
        removed = vx.transitions.remove(divided, 5).tissue
        assert int(removed.alive.sum()) == N
        assert float(removed.areas.sum()) == pytest.approx(N, rel=1e-5)

    @pytest.mark.parametrize(
        "make",
        [
            lambda t: vx.costs.VertexDistance(t),
            lambda t: vx.costs.CellAreas(t.areas + 0.1),
            lambda t: vx.costs.MeanShapeFactor(3.8),
        ],
        ids=["vertices", "areas", "shape"],
    )
    @pytest.mark.thorough
    def test_costs_have_finite_gradients(self, rest, make):
        tissue, energy = rest
        cost = make(tissue)
        moved = tissue.vertices + 0.03 * jnp.sin(5 * tissue.vertices)
        slope = jax.grad(lambda x: cost(tissue.with_vertices(x), energy))(moved)
        assert np.isfinite(slope).all()
        assert np.abs(slope).max() > 0


@pytest.mark.thorough
def test_posterior_density_has_a_finite_gradient(rest):
    pytest.importorskip("numpyro", reason="needs the extra bayes")
    import numpyro.distributions as dist

    tissue, energy = rest
    target = tissue.with_vertices(tissue.vertices + 0.01 * jnp.sin(9 * tissue.vertices))
    cost = vx.costs.VertexDistance(target)
    problem = vx.InverseProblem(tissue, energy, cost, response=FIXED_TOPOLOGY)
    prior = {"target_shape_factor": dist.Normal(3.65, 0.1)}
    density = vx.bayes.LogPosterior(problem, prior, 0.01)
    slope = jax.grad(lambda p: density({"target_shape_factor": p}))(jnp.asarray(TRUTH))
    assert slope.dtype == jnp.float32
    assert np.isfinite(slope).all()


@pytest.mark.thorough
def test_free_tissue_grows_and_divides():
    tissue = vx.initialise.free_voronoi(4, key=0, lloyd_steps=2).with_capacity(9)

    def energy(cells):
        elasticity = AreaElasticity(1.0, cells.target_area) + PerimeterElasticity(0.02, 0.0)
        return elasticity + LineTension(0.02)

    cycle, times = vx.growth.GrowAndDivide(0.2, 1.5), jnp.linspace(0, 4, 6)
    # (Without contacts daughters may overlap.)
    relaxation = vx.Relaxation(transitions=None)
    grown = vx.growth.grow(tissue, energy, cycle, times, key=1, relaxation=relaxation)
    assert grown.converged
    assert grown.n_alive[-1] > 5
    assert floats(grown.tissue) == {"float32"}


@pytest.mark.thorough
def test_standard_deviations_are_as_large_as_the_errors(rest):
    tissue, energy = rest
    noise = 0.01 * jax.random.normal(jax.random.key(1), tissue.vertices.shape)
    cost = vx.costs.VertexDistance(tissue.with_vertices(tissue.vertices + noise))
    start = ShapeFactorEnergy(jnp.full(N, 3.7))
    problem = vx.InverseProblem(tissue, start, cost, response=FIXED_TOPOLOGY)
    fit = vx.fit(problem, LEAST_SQUARES, epochs=30)
    deviation = vx.uncertainty(problem, fit).deviation.target_shape_factor
    score = (fit.energy.target_shape_factor - energy.target_shape_factor) / deviation
    assert 0.3 < jnp.sqrt(jnp.mean(score**2)) < 2


@pytest.mark.parametrize("make", [vx.initialise.hexagonal, vx.initialise.free_voronoi])
def test_tissue_far_from_the_origin_is_rejected(make):
    tissue = make(4, 4) if make is vx.initialise.hexagonal else make(N, key=0)
    energy = AreaElasticity(1.0, 1.0)
    with pytest.raises(ValueError, match="Subtract the mean of the vertices"):
        vx.equilibrate(tissue.with_vertices(tissue.vertices + 1e4), energy)
