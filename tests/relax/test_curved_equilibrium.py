"""Equilibria of tissues on surfaces, their derivatives, and their motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import FIXED_TOPOLOGY, central_difference, fine_difference, random_tissue

import vertax as vx
from vertax.energies import AreaElasticity, LineTension, PerimeterElasticity
from vertax.energies._scales import scales_of
from vertax.relax._equilibrium import free_motions
from vertax.surfaces import Cylinder, Graph, HeightMap, SphericalCap

SIDE, N_CELLS = 3.0, 9
FRICTION = vx.dissipations.SubstrateFriction(1.0)
MOMENTUM = vx.Relaxation(
    vx.solvers.Optax(optax.sgd(5e-3, momentum=0.9)), None, contact_range=None, max_steps=20_000
)


def wave(height, x):
    return height * jnp.cos(2 * jnp.pi * x[0] / SIDE) * jnp.cos(2 * jnp.pi * x[1] / SIDE)


def bump(height):
    return Graph(jax.tree_util.Partial(wave, jnp.asarray(height)))


def height_map(height):
    x = (jnp.arange(8) + 0.5) * SIDE / 8
    heights = jnp.cos(2 * jnp.pi * x / SIDE)[:, None] * jnp.cos(2 * jnp.pi * x / SIDE)
    return HeightMap(height * heights, SIDE / 8, periodic=True)


# Functions of one number that return a surface, and that number.
SURFACES = {
    "bump": (bump, 0.4),
    "tube": (Cylinder, SIDE / (2 * np.pi)),
    "map": (height_map, 0.4),
}

# (A relaxation on a height map compiles for half a minute.)
MAP = pytest.param("map", marks=pytest.mark.thorough)


@pytest.fixture(scope="module")
def flat():
    return random_tissue(N_CELLS, 4, lloyd_steps=3)


def elastic(numbers):
    areas = 1 + 0.1 * jnp.cos(jnp.arange(N_CELLS))
    shape = PerimeterElasticity(jnp.ones(()), 3.5 * numbers[1])
    return AreaElasticity(jnp.full((), 20.0), numbers[0] * areas) + shape


def free_cluster(centre):
    cluster = vx.initialise.free_voronoi(N_CELLS, key=1, lloyd_steps=3)
    vertices = cluster.vertices - jnp.mean(cluster.vertices, axis=0) + jnp.asarray(centre)
    return vx.Tissue(vertices, cluster.topology, cluster.boundary)


@pytest.mark.thorough
def test_a_foam_comes_to_rest_on_a_steep_surface_with_transitions():
    steep = Graph(lambda x: 0.9 * jnp.cos(2 * jnp.pi * x[0] / 5) * jnp.cos(2 * jnp.pi * x[1] / 5))
    tissue = random_tissue(25, 1).with_surface(steep)
    relaxed = vx.equilibrate(tissue, AreaElasticity(20.0, 1.0) + LineTension(0.6))
    assert int(relaxed.num_t1) > 0
    assert int(relaxed.num_steps) < 100
    assert not relaxed.tissue.overlaps.any
    assert relaxed.tissue.surface is not None


@pytest.mark.parametrize("name", [pytest.param("bump", marks=pytest.mark.thorough), "tube", MAP])
@pytest.mark.thorough
def test_translations_are_zero_modes_only_where_the_surface_is_homogeneous(flat, name):
    (make, number), free = SURFACES[name], name == "tube"
    tissue, energy = flat.with_surface(make(number)), elastic(jnp.ones(2))
    relaxed = FIXED_TOPOLOGY(tissue, energy).tissue
    assert np.all(free_motions(relaxed, energy, scales_of(relaxed, energy)) == free)
    drift = jnp.mean(relaxed.vertices - tissue.vertices, axis=0)
    assert (float(jnp.max(jnp.abs(drift))) < 1e-12) == free


@pytest.mark.thorough
def test_the_energy_of_a_tube_approaches_that_of_the_plane_with_second_order(flat):
    energy = elastic(jnp.ones(2))
    plane = float(FIXED_TOPOLOGY(flat, energy).energy)
    differences = []
    for turns in (2, 4, 8):  # (The chart of the box covers a part of the tube.)
        tube = eqx.tree_at(
            lambda t: t.surface,
            flat,
            Cylinder(turns * SIDE / (2 * np.pi)),
            is_leaf=lambda x: x is None,
        )
        differences.append(float(FIXED_TOPOLOGY(tube, energy).energy) - plane)
    assert np.all(np.abs(np.diff(np.log2(np.abs(differences))) + 2) < 0.1)


def cost_of(flat, name, response, adjoint):
    """A function of parameters of the energy and of the surface, which depends on the position too."""
    make, _ = SURFACES[name]

    def cost(numbers):
        tissue = eqx.tree_at(
            lambda t: t.surface, flat, make(numbers[2]), is_leaf=lambda x: x is None
        )
        tissue = response(tissue, elastic(numbers[:2]), adjoint=adjoint).tissue
        weights = jnp.cos(jnp.arange(N_CELLS))
        place = jnp.sum(jnp.sin(tissue.vertices.ravel()))
        return jnp.sum(tissue.perimeters**2 * weights) + 0.1 * place

    return eqx.filter_jit(cost)


@pytest.mark.parametrize(
    ("adjoint", "response", "rtol"),
    [
        pytest.param(vx.ImplicitDifferentiation(), FIXED_TOPOLOGY, 1e-5, id="implicit"),
        pytest.param(
            vx.EquilibriumPropagation(),
            FIXED_TOPOLOGY,
            1e-4,
            id="propagation",
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            vx.AutomaticDifferentiation(),
            MOMENTUM,
            1e-4,
            id="automatic",
            marks=pytest.mark.thorough,
        ),
    ],
)
@pytest.mark.parametrize("name", ["bump", pytest.param("tube", marks=pytest.mark.thorough), MAP])
def test_gradients_by_energy_and_surface_agree_with_differences(
    flat, name, adjoint, response, rtol
):
    numbers = jnp.array([1.0, 1.0, SURFACES[name][1]])
    gradient = jax.grad(cost_of(flat, name, response, adjoint))(numbers)
    # (The third derivatives of a height map jump, so that the steps must be small.)
    precise = dataclasses.replace(FIXED_TOPOLOGY, tolerance=1e-11)
    value = cost_of(flat, name, precise, vx.ImplicitDifferentiation())
    differences = [central_difference(value, numbers, step, 1e-5) for step in np.eye(3)]
    size = np.abs(differences).max()
    np.testing.assert_allclose(gradient, differences, rtol=rtol, atol=rtol * size)


@pytest.mark.thorough
def test_gradients_of_a_free_tissue_on_a_cap_agree_with_differences():
    tissue = free_cluster([0.4, 0.2]).with_surface(SphericalCap(4.0))

    @eqx.filter_jit
    def cost(numbers):
        relaxed = FIXED_TOPOLOGY(tissue, elastic(numbers)).tissue
        return jnp.sum(relaxed.perimeters * jnp.cos(jnp.arange(N_CELLS)))

    gradient = jax.grad(cost)(jnp.ones(2))
    differences = [fine_difference(cost, jnp.ones(2), step, 1e-3) for step in np.eye(2)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-4)


@pytest.mark.thorough
def test_a_step_across_the_rim_of_a_cap_is_rejected_or_returns():
    # The tissue would be larger than the cap: it stays on its continuation, with finite numbers.
    tissue = free_cluster([0.0, 0.0]).with_surface(SphericalCap(2.6))
    relaxed = FIXED_TOPOLOGY(tissue, elastic(jnp.array([1.5, 1.2])), throw=False)
    assert np.isfinite(relaxed.tissue.vertices).all()
    assert bool(relaxed.converged)


@pytest.mark.thorough
def test_members_of_a_batch_of_surfaces_are_those_one_by_one(flat):
    heights, energy = jnp.array([0.2, 0.5]), elastic(jnp.ones(2))
    run = lambda h: FIXED_TOPOLOGY(flat.with_surface(bump(h)), energy).energy
    together = jax.vmap(run)(heights)
    np.testing.assert_allclose(together, [run(h) for h in heights], rtol=1e-9)


@pytest.mark.thorough
def test_float32_comes_to_rest(flat):
    to_single = lambda x: x.astype(np.float32) if x.dtype == np.float64 else x
    tissue, energy = flat.with_surface(Cylinder(SIDE / (2 * np.pi))), elastic(jnp.ones(2))
    relaxed = FIXED_TOPOLOGY(*jax.tree.map(to_single, (tissue, eqx.filter(energy, eqx.is_array))))
    assert relaxed.tissue.vertices.dtype == jnp.float32
    exact = FIXED_TOPOLOGY(tissue, energy).energy
    assert float(relaxed.energy) == pytest.approx(float(exact), rel=1e-4)


@pytest.mark.thorough
def test_evolution_lowers_the_energy_with_velocities_in_space(flat):
    tissue, energy = flat.with_surface(bump(0.4)), elastic(jnp.ones(2))
    run = vx.evolve(tissue, energy, FRICTION, [0.0, 1e-4, 2e-4, 1.0], relaxation=FIXED_TOPOLOGY)
    assert np.all(np.diff(run.energies) < 0)
    metric = tissue.surface.metric(tissue.vertices)
    force = -jax.grad(lambda x: energy(tissue.with_vertices(x)))(tissue.vertices)
    expected = jnp.linalg.solve(metric, force[..., None])[..., 0]
    velocity = vx.mechanics.velocities(tissue, energy, FRICTION)
    np.testing.assert_allclose(velocity, expected, atol=1e-8 * float(jnp.max(jnp.abs(expected))))
    first = (run.frames.vertices[1] - tissue.vertices) / 1e-4
    np.testing.assert_allclose(first, expected, atol=0.02 * float(jnp.max(jnp.abs(expected))))


def test_thermal_forces_have_the_covariance_of_friction_in_space(flat):
    tissue, noise = flat.with_surface(bump(0.4)), vx.activities.ThermalNoise(0.5)
    metric = tissue.surface.metric(tissue.vertices)

    @jax.jit
    @jax.vmap
    def forces(key):
        push, _ = noise.drive(None, tissue, FRICTION, jnp.array(0.0), jnp.array(0.1), key)
        return push.force

    samples = forces(jax.random.split(jax.random.key(0), 20_000))
    covariance = jnp.einsum("svi,svj->vij", samples, samples) / len(samples)
    # 2 T ζ g / Δt
    np.testing.assert_allclose(covariance, 10.0 * metric, atol=0.5)


@pytest.mark.thorough
def test_cells_divide_and_vanish_on_a_surface(flat):
    tissue = flat.with_surface(bump(0.4)).with_capacity(N_CELLS + 2)
    divided = vx.transitions.divide(tissue, 3).tissue
    assert int(jnp.sum(divided.alive)) == N_CELLS + 1
    assert float(jnp.sum(divided.areas)) == pytest.approx(float(jnp.sum(tissue.areas)), rel=2e-3)
    shrinks = jnp.arange(tissue.n_cells) == 2
    pull = jnp.where(jnp.any(tissue.topology.edge_cells == 2, axis=1), 3.0, 0.3)
    energy = AreaElasticity(jnp.where(shrinks, 0.0, 5.0), 1.2) + LineTension(pull)
    rules = vx.T1() + vx.T2(0.2)
    relaxed = vx.Relaxation(transitions=rules, contact_range=None)(tissue, energy).tissue
    assert int(jnp.sum(relaxed.alive)) == N_CELLS - 1
    assert relaxed.surface is not None


@pytest.mark.thorough
def test_a_fit_recovers_target_areas_on_a_surface(flat):
    start = flat.with_surface(bump(0.4))
    true = jnp.asarray(1.2 + 0.1 * np.cos(np.arange(N_CELLS)))
    energy = lambda areas: AreaElasticity(areas / areas, areas) + PerimeterElasticity(0.1, 3.5)
    target = FIXED_TOPOLOGY(start, energy(true)).tissue
    guess = energy(jnp.full(N_CELLS, 1.2))
    problem = vx.InverseProblem(
        start, guess, vx.costs.VertexDistance(target), response=FIXED_TOPOLOGY
    )
    history = vx.fit(problem, optax.adam(1e-2), 60, progress=False).history
    assert history.cost[-1] < 1e-2 * history.cost[0]


def test_a_box_that_changes_is_rejected(flat):
    tissue = flat.with_surface(bump(0.4))
    with pytest.raises(ValueError, match="surface"):
        vx.evolve(
            tissue, elastic(jnp.ones(2)), FRICTION, [0.0, 0.1], boundary=lambda t: flat.boundary
        )
