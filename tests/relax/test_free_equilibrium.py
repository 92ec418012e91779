"""Equilibria of free tissues: drops, force balance, gradients, pinned vertices."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from free_helpers import angles_of, cluster, doublet, forces, rotated, with_angles
from helpers import central_difference, each_solver, random_like
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq

import vertax as vx
from vertax.costs import MeshImage, VertexDistance, render
from vertax.energies import AreaElasticity, LineTension

K = 10.0


def drops(tension, target_area: Any = 1.0):
    return AreaElasticity(K, target_area) + LineTension(jnp.asarray(tension))


# Clusters at rest do not touch themselves: without contacts half as much is compiled.
equilibrate = functools.partial(vx.equilibrate, contact_range=None)


def relax(tissue, energy, **options):
    return equilibrate(tissue, energy, tolerance=1e-11, **options).tissue


def pressures(tissue, target_area):
    """Of the cells, and 0 of the exterior."""
    return jnp.append(K * (target_area - tissue.areas), 0.0)


@eqx.filter_jit
def imbalance(tissue, tension, target_area):
    """Largest deviation from Young-Laplace at arcs, and from force balance at vertices."""
    left, right = pressures(tissue, target_area)[tissue.topology.edge_cells].T
    laplace = jnp.where(tissue.is_arc, tension * tissue.edge_curvatures - (left - right), 0)
    start, end = tissue.edge_tangents
    # A straight edge does not yield to a difference of pressures: it hands half of it to either end.
    chord = tissue.edge_vectors
    normal = jnp.stack([chord[:, 1], -chord[:, 0]], axis=1)
    push = jnp.where(tissue.is_arc, 0, (left - right) / 2)[:, None] * normal
    v, w = tissue.topology.edge_vertices.T
    force = jnp.zeros_like(tissue.vertices)
    tension = jnp.broadcast_to(tension, left.shape)[:, None]
    force = force.at[v].add(tension * start + push).at[w].add(-tension * end + push)
    return jnp.maximum(jnp.abs(laplace).max(), jnp.abs(force).max())


@pytest.mark.thorough
@pytest.mark.parametrize("gamma", [0.3, 1.0])
def test_two_cells_without_interfacial_tension_are_one_drop(gamma):
    tissue = relax(doublet(), drops([gamma, 0.0, gamma], jnp.ones(2)), transitions=None)
    radius = 1 / tissue.edge_curvatures[0]
    assert tissue.edge_curvatures[2] == pytest.approx(float(1 / radius), abs=1e-9)
    np.testing.assert_allclose(tissue.areas, np.pi * radius**2 / 2, rtol=1e-9)
    np.testing.assert_allclose(K * (1 - tissue.areas), gamma / radius, rtol=1e-8)


@pytest.mark.parametrize("inner_arcs", [pytest.param(False, marks=pytest.mark.thorough), True])
@pytest.mark.parametrize("ratio", [0.4, 1.0, 1.7])
def test_symmetric_doublet(ratio, inner_arcs):
    # γ_int = 2 γ cos θ, A = R² (π - θ + sin θ cos θ), K (A0 - A) = γ / R.
    gamma = 0.8
    theta = np.arccos(ratio / 2)
    area = lambda r: r**2 * (np.pi - theta + np.sin(theta) * np.cos(theta))
    radius: Any = brentq(lambda r: K * (1 - area(r)) - gamma / r, 0.35, 2.0, xtol=1e-15)
    start = doublet(inner_arcs=inner_arcs)
    tissue = relax(start, drops([gamma, ratio * gamma, gamma], jnp.ones(2)), transitions=None)
    np.testing.assert_allclose(tissue.areas, area(radius), rtol=1e-8)
    np.testing.assert_allclose(tissue.edge_curvatures[jnp.array([0, 2])], 1 / radius, rtol=1e-8)
    np.testing.assert_allclose(tissue.edge_angles, [np.pi - theta, 0, np.pi - theta], atol=1e-8)
    assert tissue.edge_lengths[1] == pytest.approx(2 * radius * np.sin(theta), rel=1e-8)


def test_asymmetric_doublet_and_the_neumann_triangle():
    tension, target = jnp.array([0.9, 0.7, 1.2]), jnp.array([0.7, 1.4])
    tissue = relax(doublet(inner_arcs=True), drops(tension, target), transitions=None)
    assert jnp.abs(tissue.edge_angles[1]) > 0.05
    assert imbalance(tissue, tension, target) < 1e-8
    # Angles between the films follow from the tensions alone: the law of cosines.
    start, _ = tissue.edge_tangents
    outward = jnp.where(tissue.topology.edge_vertices[:, :1] == 0, start, -tissue.edge_tangents[1])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        a, b, c = tension[jnp.array([i, j, k])]
        cosine = (c**2 - a**2 - b**2) / (2 * a * b)
        assert jnp.dot(outward[i], outward[j]) == pytest.approx(float(cosine), abs=1e-8)
    # The curvatures of three films that meet add up as the pressures do.
    np.testing.assert_allclose(
        tension * tissue.edge_curvatures,
        [
            pressures(tissue, target)[1],
            jnp.diff(pressures(tissue, target)[tissue.topology.edge_cells[1]])[0] * -1,
            pressures(tissue, target)[0],
        ],
        atol=1e-8,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 1])
def test_triplets(seed):
    target = jnp.array([0.6, 1.0, 1.5])
    tension = 0.5 + 0.2 * jax.random.uniform(jax.random.key(seed), (6,))
    start = cluster(3, seed, inner_arcs=True, softening=0.0)
    tissue = relax(start, drops(tension, target), transitions=None)
    assert jnp.abs(jnp.where(tissue.topology.on_outline, 0, tissue.edge_angles)).max() > 0.03
    assert imbalance(tissue, tension, target) < 1e-8


@pytest.mark.thorough
@pytest.mark.parametrize("inner_arcs", [pytest.param(False, marks=pytest.mark.slow), True])
def test_young_laplace_and_force_balance_in_random_clusters(inner_arcs):
    n, target, num_t1 = 12, jnp.linspace(0.7, 1.3, 12), 0
    for k in range(3):
        start = cluster(n, k, inner_arcs=inner_arcs, softening=1e-6)
        tension = 0.6 + 0.3 * np.random.default_rng(k).random(start.n_edges)
        energy = drops(tension, target)
        equilibrium = vx.equilibrate(start, energy, tolerance=1e-10)
        equilibrium.tissue.topology.validate()
        assert imbalance(equilibrium.tissue, jnp.asarray(tension), target) < 1e-7
        force, torque = forces(equilibrium.tissue, energy)
        assert max(np.abs(force).max(), np.abs(torque).max()) < 1e-9
        num_t1 += int(equilibrium.num_t1)
    assert num_t1 > 0


@each_solver("newton_cg", "fire")
def test_all_solvers_reach_the_same_drop(solver, force):
    tension, target = jnp.array([0.9, 0.7, 1.2]), jnp.array([0.7, 1.4])
    energy = AreaElasticity(0.2 * K, target) + LineTension(0.2 * tension)
    start = relax(doublet(inner_arcs=True), drops(tension, 0.9 * target), transitions=None)
    options = {"solver": solver, "tolerance": 10 * force, "max_steps": 3000, "transitions": None}
    equilibrium = equilibrate(start, energy, throw=False, **options)
    assert equilibrium.converged, (equilibrium.max_force, equilibrium.num_steps)
    exact = relax(start, energy, transitions=None)
    np.testing.assert_allclose(equilibrium.tissue.areas, exact.areas, atol=100 * force)


@pytest.mark.thorough
def test_units_of_length_do_not_matter_to_the_solver():
    # Micrometres: lengths and angles differ by orders of magnitude, and the energy has a scale too.
    unit = 20.0
    start = cluster(8, 5)
    large = vx.Tissue(unit * start.vertices, start.topology, vx.Free(), angles=start.angles)
    energy = drops(0.8)
    scaled = AreaElasticity(K / unit**4, unit**2) + LineTension(jnp.asarray(0.8 / unit))
    small_one = equilibrate(start, energy)
    large_one = equilibrate(large, scaled)
    assert large_one.num_steps <= 2 * small_one.num_steps
    np.testing.assert_allclose(angles_of(large_one.tissue), angles_of(small_one.tissue), atol=1e-7)


@pytest.mark.parametrize("angles", [(3.6, 0.0, 3.6), (5.0, 0.0, 1.0)])
def test_overstretched_arcs_relax(angles):
    start = with_angles(doublet(), jnp.array(angles))
    tissue = relax(start, drops([1.0, 1.0, 1.0], jnp.ones(2)), transitions=None)
    np.testing.assert_allclose(tissue.edge_angles[jnp.array([0, 2])], 2 * np.pi / 3, atol=1e-8)


def hypergradient_problem(tissue, seed=0, **options):
    """A loss that sees everything: positions, orientation, angles."""
    target = tissue.with_vertices(tissue.vertices + 0.1 * random_like(tissue.vertices, 5))

    def loss(tension, start=tissue, adjoint=vx.ImplicitDifferentiation()):
        energy = drops(tension)
        settings = {"tolerance": 1e-12, "adjoint": adjoint, "throw": False} | options
        equilibrium = equilibrate(start, energy, **settings)
        at = equilibrium.tissue
        return VertexDistance(target)(at, energy) + jnp.sum(jnp.sin(at.edge_angles)), equilibrium

    return loss, 0.7 + 0.2 * jax.random.uniform(jax.random.key(seed), (tissue.n_edges,))


@pytest.mark.parametrize("inner_arcs", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.thorough
def test_hypergradient_from_far_away_against_central_differences(inner_arcs):
    # The relaxation starts out of equilibrium, with T1s on the way: the orientation in which it ends
    # must not depend on the solver's way there, or the gradient would miss that.
    loss, tension = hypergradient_problem(cluster(8, 4, inner_arcs=inner_arcs))
    evaluate = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, equilibrium), gradient = evaluate(tension)
    assert equilibrium.converged
    direction = random_like(tension)
    difference = central_difference(lambda g: evaluate(g)[0][0], tension, direction)
    assert jnp.sum(gradient * direction) == pytest.approx(float(difference), rel=1e-6)


# Clusters that are not about to undergo a T1 transition, where positions jump.
@pytest.mark.thorough
@pytest.mark.parametrize(("n_pinned", "seed"), [pytest.param(1, 1, marks=pytest.mark.slow), (3, 6)])
def test_pinned_vertices_stay_and_are_differentiable(n_pinned, seed):
    free = cluster(7, seed)
    pinned = jnp.zeros(free.n_vertices, bool).at[jnp.arange(n_pinned) * 3].set(True)
    tissue = eqx.tree_at(lambda t: t.pinned, free, pinned, is_leaf=lambda x: x is None)
    loss, tension = hypergradient_problem(tissue, transitions=None)

    def of_pins(pins):
        vertices = jnp.where(pinned[:, None], pins, tissue.vertices)
        return loss(tension, tissue.with_vertices(vertices))

    evaluate = jax.jit(jax.value_and_grad(of_pins, has_aux=True))
    (_, equilibrium), gradient = evaluate(tissue.vertices)
    assert equilibrium.converged
    np.testing.assert_array_equal(equilibrium.tissue.vertices[pinned], tissue.vertices[pinned])
    assert jnp.abs(equilibrium.tissue.vertices - tissue.vertices)[~pinned].max() > 1e-3
    np.testing.assert_array_equal(gradient[~pinned], 0)
    direction = random_like(tissue.vertices)
    difference = central_difference(lambda x: evaluate(x)[0][0], tissue.vertices, direction)
    assert jnp.sum(gradient * direction) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.thorough
def test_pinned_vertices_of_a_periodic_tissue():
    crystal = vx.initialise.periodic_voronoi(9, key=jax.random.key(2))
    pinned = jnp.zeros(18, bool).at[jnp.array([0, 7])].set(True)
    tissue = vx.Tissue(crystal.vertices, crystal.topology, crystal.boundary, pinned=pinned)

    def loss(p):
        energy = vx.energies.ShapeFactorEnergy(p)
        equilibrium = equilibrate(tissue, energy, transitions=None, tolerance=1e-12)
        return jnp.sum(equilibrium.tissue.vertices), equilibrium

    evaluate = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, equilibrium), slope = evaluate(jnp.array(3.6))
    np.testing.assert_array_equal(equilibrium.tissue.vertices[pinned], crystal.vertices[pinned])
    # The gauge, which no pinned tissue needs, must not hold the centroid: it is pulled along.
    assert jnp.abs(jnp.mean(equilibrium.tissue.vertices - crystal.vertices, axis=0)).max() > 1e-4
    difference = central_difference(lambda p: evaluate(p)[0][0], jnp.array(3.6), 1.0)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.thorough
def test_equilibria_turn_with_the_tissue():
    start, energy = cluster(8, 4), drops(0.8)
    run = lambda t: relax(t, energy)
    np.testing.assert_allclose(
        run(rotated(start, 0.8, (3.0, -1.0))).vertices,
        rotated(run(start), 0.8, (3.0, -1.0)).vertices,
        atol=1e-7,
    )


@pytest.mark.thorough
def test_the_gauge_makes_the_hessian_regular():
    tissue = relax(cluster(8, 4), drops(0.8))
    y, unravel = ravel_pytree(tissue.configuration)
    energy = drops(0.8)
    at = lambda z: energy(tissue.with_configuration(unravel(z)))
    drift = lambda z: 0.5 * jnp.sum(tissue.drift(unravel(z)) ** 2)
    spectrum = jnp.linalg.eigvalsh(jax.jit(jax.hessian(at))(y))
    n_straight = int(jnp.sum(~tissue.is_arc))
    assert int(jnp.sum(jnp.abs(spectrum) < 1e-8)) == 3 + n_straight
    held = jnp.linalg.eigvalsh(jax.jit(jax.hessian(lambda z: at(z) + drift(z)))(y))
    assert held[0] > 1e-3
    # One zero mode of the energy becomes an eigenvalue 1; the others are what they were.
    np.testing.assert_allclose(
        jnp.sort(jnp.concatenate([spectrum[3 + n_straight :], jnp.ones(3 + n_straight)])),
        held,
        atol=1e-7,
    )


@pytest.mark.thorough
def test_float32():
    tissue = cluster(8, 4)
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    small = jax.tree.map(to32, tissue)
    equilibrium, exact = equilibrate(small, drops(0.8)), equilibrate(tissue, drops(0.8))
    assert equilibrium.tissue.vertices.dtype == angles_of(equilibrium.tissue).dtype == jnp.float32
    np.testing.assert_allclose(equilibrium.tissue.areas, exact.tissue.areas, rtol=1e-3)
    np.testing.assert_allclose(equilibrium.tissue.edge_angles, exact.tissue.edge_angles, atol=5e-3)


@pytest.mark.slow  # designs of clusters fit tensions, too
def test_a_fit_finds_line_tensions():
    start = cluster(6, 3, lloyd_steps=3)
    truth = LineTension(1.0 + 0.15 * jax.random.normal(jax.random.key(2), (start.n_edges,)))
    area = AreaElasticity(K, 1.0)
    target = vx.equilibrate(start, area + truth).tissue
    problem = vx.InverseProblem(
        tissue=target,
        energy=area + LineTension(jnp.ones(start.n_edges)),
        cost=VertexDistance(target),
        fit_position=True,
    )
    fit = vx.fit(problem, optax.adam(1e-2), 40, progress=False)
    assert fit.cost < 0.1 * fit.history.cost[0]


@pytest.mark.thorough
def test_images_of_free_tissues():
    tissue = cluster(6, 1, random_angles=True)
    tissue = tissue.with_vertices(tissue.vertices - tissue.vertices.min(0) + 0.8)
    image = eqx.filter_jit(lambda t: render(t, (40, 50), 0.2, pixel_size=0.1))(tissue)
    # Many points on the arcs, each a Gaussian.
    points = np.asarray(tissue.edge_points(jnp.linspace(0, 1, 201)))
    middle, mass = (points[:, 1:] + points[:, :-1]) / 2, np.asarray(tissue.edge_lengths) / 200
    x, y = 0.1 * (np.arange(50) + 0.5), 0.1 * (np.arange(40) + 0.5)
    gauss = lambda r, p: (
        np.exp(-((r - p[..., None]) ** 2) / (2 * 0.2**2)) / np.sqrt(2 * np.pi) / 0.2
    )
    expected = np.einsum("e,epi,epj->ij", mass, gauss(y, middle[..., 1]), gauss(x, middle[..., 0]))
    np.testing.assert_allclose(image, expected, atol=2e-4 * expected.max())
    cost = MeshImage(np.asarray(image), 0.2, pixel_size=0.1)
    loss = lambda y: cost(tissue.with_configuration(y), drops(1.0))
    evaluate = jax.jit(jax.value_and_grad(loss))
    y = tissue.configuration
    assert evaluate(y)[0] == pytest.approx(0, abs=1e-12)
    y = jax.tree.map(lambda x: x + 0.05, y)
    direction = random_like(y)
    slope = sum(jnp.sum(a * b) for a, b in zip(evaluate(y)[1], direction, strict=True))
    difference = central_difference(lambda y: evaluate(y)[0], y, direction)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.thorough
def test_images_show_nothing_of_what_lies_outside():
    tissue = cluster(4, 1)
    far = tissue.with_vertices(tissue.vertices + jnp.array([60.0, 2.0]))
    assert jnp.abs(render(far, (40, 50), 0.2, pixel_size=0.1)).max() < 1e-9
    with pytest.raises(ValueError, match="`pixel_size` must be given"):
        render(tissue, (40, 50), 0.2)
    with pytest.raises(ValueError, match="`pixel_size` must be positive"):
        MeshImage(np.eye(8), 0.2, pixel_size=0.0)
    periodic = vx.initialise.hexagonal(2, 2)
    with pytest.raises(ValueError, match="None for a periodic one"):
        render(periodic, (40, 50), 0.2, pixel_size=0.1)
