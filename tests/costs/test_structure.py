"""Costs between tissues of different topology: adjacency, transport, centroids, vertices matched by cells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from free_helpers import cluster
from helpers import (
    FIXED_TOPOLOGY,
    NO_CONTACT,
    central_difference,
    dense_hypergradient,
    edge_cell_sets,
    p0_of,
    random_like,
    random_tissue,
    relaxed,
    shape_factors,
    value_of,
)
from hypothesis import given, settings, strategies as st
from scipy.optimize import linear_sum_assignment

import vertax as vx
from vertax.costs import (
    CentroidDistance,
    IndexAwareStructural,
    VertexDistance,
    adjacency,
    mismatched_neighbours,
)
from vertax.costs._positions import matching_vertices
from vertax.costs._transport import entropic_transport, transport_plan
from vertax.transitions._euler_operators import flip_edges

energy = vx.energies.ShapeFactorEnergy(3.7)


@eqx.filter_jit
def flipped(tissue, length: float | jax.Array = 1e-9):
    """The tissue with its shortest edge shrunk to a length, before and after a T1 of that edge."""
    edge = jnp.argmin(tissue.edge_lengths)
    half = tissue.topology.half_edge[edge]
    start, end = half // 3, tissue.topology.twin[half] // 3
    vector = tissue.edge_vectors[edge]
    unit = vector / jnp.linalg.norm(vector)
    middle = tissue.vertices[start] + vector / 2

    def placed(direction):
        half_vector = direction * length / 2
        offset = tissue.vertices[end] - (tissue.vertices[start] + vector)
        return (
            tissue.vertices.at[start]
            .set(middle - half_vector)
            .at[end]
            .set(middle + half_vector + offset)
        )

    before = tissue.with_vertices(placed(unit))
    across = jnp.stack([unit[1], -unit[0]])
    mask = jnp.arange(tissue.n_edges) == edge
    after = tissue.with_vertices(placed(across)).with_topology(flip_edges(tissue.topology, mask))
    return before, after


# --- transport


@pytest.mark.parametrize("epsilon", [1e-3, 0.1, 3.0])
@pytest.mark.parametrize("n", [2, 20, 60])
def test_plan_is_balanced_and_optimal_for_any_entropy(n, epsilon):
    costs = 3 * jax.random.uniform(jax.random.key(n), (n, n))
    log_plan = np.asarray(jax.jit(transport_plan)(costs, jnp.asarray(epsilon)))
    plan = np.exp(log_plan)
    np.testing.assert_allclose(plan.sum(axis=0), 1 / n, rtol=1e-11)
    np.testing.assert_allclose(plan.sum(axis=1), 1 / n, rtol=1e-11)
    # Optimality: log P = -C/ε + u_i + v_j with row and column potentials u and v.
    potentials = log_plan + np.asarray(costs) / epsilon
    mixed = potentials - potentials[:1] - potentials[:, :1] + potentials[0, 0]
    assert np.abs(mixed).max() < 1e-9 * np.abs(potentials).max()


def test_small_entropy_gives_the_optimal_assignment():
    costs = jax.random.uniform(jax.random.key(3), (15, 15))
    rows, columns = linear_sum_assignment(costs)
    best = float(np.mean(np.asarray(costs)[rows, columns]))
    assert entropic_transport(costs, jnp.asarray(1e-4)) == pytest.approx(best, abs=1e-5)


def test_plan_near_a_permutation_converges():
    # Plain Sinkhorn iterations would need about 1e6 sweeps.
    costs = jnp.where(jnp.eye(20, dtype=bool), 0.9, 2.4) + 0.1 * jax.random.uniform(
        jax.random.key(0), (20, 20)
    )
    plan = np.exp(transport_plan(costs, jnp.asarray(0.1)))
    np.testing.assert_allclose(plan.sum(axis=1), 1 / 20, rtol=1e-11)


def test_unbalanced_plan_is_nan(monkeypatch):
    from vertax.costs import _transport

    monkeypatch.setattr(_transport, "_MAX_SWEEPS", 2)
    costs = jax.random.uniform(jax.random.key(1), (12, 12))
    assert np.isnan(transport_plan(costs, jnp.asarray(1e-4))).all()


@pytest.mark.parametrize("epsilon", [0.05, 0.5])
def test_transport_derivatives_match_finite_differences(epsilon):
    costs = 2 * jax.random.uniform(jax.random.key(5), (8, 8))
    at = (costs, jnp.asarray(epsilon))
    slope = jax.jit(jax.grad(entropic_transport, argnums=(0, 1)))
    direction = (random_like(costs), jnp.asarray(0.3))
    first = sum(jnp.sum(a * b) for a, b in zip(slope(*at), direction, strict=True))
    cost = jax.jit(lambda x: entropic_transport(*x))
    expected = central_difference(cost, at, direction, 1e-6)
    assert first == pytest.approx(float(expected), rel=1e-7)
    second = jax.jit(lambda x, d: jax.jvp(slope, x, d)[1])(at, direction)
    along = lambda x: slope(*x)[0]
    np.testing.assert_allclose(
        second[0], central_difference(along, at, direction, 1e-6), rtol=1e-5, atol=1e-7
    )


# --- the structural cost


compiled_adjacency = eqx.filter_jit(adjacency)
compiled_matching = eqx.filter_jit(matching_vertices)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 1000), st.sampled_from([5, 12]))
def test_adjacency_matches_shared_edges(seed, n_cells):
    tissue = random_tissue(n_cells, seed)
    matrix = np.asarray(compiled_adjacency(tissue))
    expected = np.zeros((n_cells, n_cells))
    for i, j in edge_cell_sets(tissue):
        if i != j:
            expected[i, j] = expected[j, i] = 1
    np.testing.assert_array_equal(matrix, expected)
    weighted = np.asarray(compiled_adjacency(tissue, 0.1))
    np.testing.assert_allclose(weighted, weighted.T)
    assert ((weighted > 0) == (matrix > 0)).all()


@pytest.mark.thorough
@pytest.mark.parametrize("boundary", ["periodic", "free"])
def test_cost_is_continuous_through_a_t1_with_nonzero_slope(boundary):
    tissue = random_tissue(12, 4) if boundary == "periodic" else cluster(12, 4, lloyd_steps=2)
    cost = IndexAwareStructural(tissue)
    before, after = flipped(tissue)
    at = lambda cost, tissue: float(value_of(cost, tissue, energy))
    assert at(cost, before) == pytest.approx(at(cost, after), abs=1e-6)
    # With the flipped tissue as target the cost decreases with the length of the edge, down to length 0.
    lengths = map(jnp.asarray, (1e-3, 1e-2, 1e-1))
    costs = [at(IndexAwareStructural(after), flipped(tissue, x)[0]) for x in lengths]
    assert costs[0] < costs[1] < costs[2]
    if (
        boundary == "periodic"
    ):  # in the cluster the shortest edge borders the exterior, which is not a cell
        assert costs[1] - costs[0] > 1e-3


def test_cost_of_a_tissue_with_itself_is_zero():
    tissue = random_tissue(20, 1)
    cost = eqx.filter_jit(IndexAwareStructural(tissue))
    assert cost(tissue, energy) == pytest.approx(0, abs=1e-6)
    assert cost(random_tissue(20, 2), energy) > 0.1
    # The cost depends on the interfaces and not on positions.
    moved = tissue.with_vertices(tissue.vertices + jnp.array([0.3, -7.0]))
    assert cost(moved, energy) == pytest.approx(float(cost(tissue, energy)), abs=1e-9)


@pytest.mark.parametrize(
    "dtype", [pytest.param(jnp.float32, marks=pytest.mark.thorough), jnp.float64]
)
def test_structural_cost_derivatives_match_finite_differences(dtype):
    tissue, target = (
        jax.tree.map(
            lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, random_tissue(12, k)
        )
        for k in (0, 1)
    )
    cost = IndexAwareStructural(target)
    evaluate = jax.jit(jax.value_and_grad(lambda x: cost(tissue.with_vertices(x), energy)))
    at, slope = (lambda x: evaluate(x)[0]), (lambda x: evaluate(x)[1])
    x, direction = tissue.vertices, random_like(tissue.vertices)
    step, close = (1e-6, 1e-7) if dtype == jnp.float64 else (1e-2, 3e-2)
    first = float(jnp.sum(slope(x) * direction))
    assert first == pytest.approx(float(central_difference(at, x, direction, step)), rel=close)
    second = jax.jit(lambda x, d: jax.jvp(slope, (x,), (d,))[1])(x, direction)
    expected = central_difference(slope, x, direction, step)
    np.testing.assert_allclose(second, expected, atol=10 * close * float(jnp.abs(expected).max()))


@pytest.mark.slow  # the partial derivatives are checked above, other hypergradients in tests/adjoints
@pytest.mark.parametrize(
    ("adjoint", "accuracy"),
    [
        (vx.ImplicitDifferentiation(), 1e-7),
        (vx.EquilibriumPropagation(), 1e-5),
        (vx.AutomaticDifferentiation(), 1e-4),
    ],
    ids=["ID", "EP", "AD"],
)
def test_structural_cost_hypergradient_is_accurate_with_all_adjoints(adjoint, accuracy):
    tissue, initial_energy = relaxed(12, 3)
    cost = IndexAwareStructural(random_tissue(12, 5))
    momentum = vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))
    solver = momentum if adjoint.unrolls else vx.solvers.NewtonCG()
    response = vx.Relaxation(solver, transitions=None, max_steps=20_000)
    problem = vx.InverseProblem(tissue, initial_energy, cost, response=response, adjoint=adjoint)
    gradient = eqx.filter_jit(problem.value_and_gradient)().gradient
    expected = dense_hypergradient(tissue, initial_energy, cost)
    error = np.linalg.norm(p0_of(gradient) - expected) / np.linalg.norm(expected)
    assert error < accuracy


@pytest.mark.thorough
def test_t1_changes_two_neighbour_pairs():
    tissue = random_tissue(20, 6)
    assert mismatched_neighbours(tissue, tissue) == 0
    before, after = flipped(random_tissue(40, 3))  # large enough: no two cells touch twice
    assert mismatched_neighbours(after, before) == 2
    assert mismatched_neighbours(tissue, random_tissue(20, 7)) > 20


@pytest.mark.parametrize("name", ["interface_length", "epsilon", "softening"])
def test_settings_must_be_positive(name):
    with pytest.raises(ValueError, match=rf"`{name}` must be positive"):
        IndexAwareStructural(random_tissue(5), **{name: 0.0})


def test_tissues_of_other_sizes_are_rejected():
    small, large = random_tissue(9), random_tissue(12)
    for cost in (IndexAwareStructural(small), CentroidDistance(small)):
        with pytest.raises(ValueError, match="must have 12 cells, as the tissue has, but has 9"):
            cost(large, energy)
    with pytest.raises(ValueError, match="mismatched_neighbours must have 12 cells"):
        mismatched_neighbours(large, small)


# --- positions


def test_centroid_distance_and_gradient_match_their_formulas():
    tissue, target = random_tissue(10, 0), random_tissue(10, 1)
    cost = CentroidDistance(target)
    separation = tissue.boundary.shortest(tissue.centroids - target.centroids)
    assert cost(tissue, energy) == pytest.approx(float(jnp.sum(separation**2)) / 20)
    at = jax.jit(jax.value_and_grad(lambda x: cost(tissue.with_vertices(x), energy)))
    direction = random_like(tissue.vertices)
    expected = central_difference(lambda x: at(x)[0], tissue.vertices, direction)
    slope = np.sum(np.asarray(at(tissue.vertices)[1] * direction))
    assert slope == pytest.approx(float(expected), rel=1e-7)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 1000), st.sampled_from([9, 20]))
def test_vertices_of_a_tissue_match_themselves(seed, n_cells):
    tissue = random_tissue(n_cells, seed)
    counterpart, matched = compiled_matching(tissue, tissue)
    unique = np.asarray(matched)
    np.testing.assert_array_equal(
        np.asarray(counterpart)[unique], np.arange(tissue.n_vertices)[unique]
    )
    if n_cells >= 20:
        assert unique.mean() > 0.9


def test_vertices_of_a_flipped_edge_have_no_counterpart():
    before, after = flipped(random_tissue(40, 2))
    counterpart, matched = compiled_matching(after, before)
    assert int(jnp.sum(~matched)) == 2
    np.testing.assert_array_equal(
        np.asarray(counterpart)[np.asarray(matched)], np.flatnonzero(np.asarray(matched))
    )
    by_cells = VertexDistance(before, match="cells")
    assert value_of(by_cells, after, energy) == pytest.approx(0, abs=1e-12)
    with pytest.raises((ValueError, TypeError), match="match"):
        VertexDistance(before, match="nearest")  # pyright: ignore[reportArgumentType]


# --- guidance


@pytest.fixture(scope="module")
def crossing():
    """True energy, target tissue, and an inverse problem with an initial tissue of another topology."""
    keys = jax.random.split(jax.random.key(8), 3)
    draw = lambda k: vx.energies.ShapeFactorEnergy(3.7 + 0.2 * jax.random.normal(k, (20,)))
    truth, guess = draw(keys[0]), draw(keys[1])
    first = vx.initialise.periodic_voronoi(20, key=keys[2])
    target, initial = (NO_CONTACT(first, e).tissue for e in (truth, guess))
    assert mismatched_neighbours(initial, target) >= 4
    cost = 0.99 * CentroidDistance(target) + 0.01 * IndexAwareStructural(target)
    return truth, target, vx.InverseProblem(initial, guess, cost)


@pytest.mark.slow  # tests/experiments has a smaller case
def test_guidance_recovers_parameters_through_t1s(crossing):
    truth, target, problem = crossing
    guidance = lambda epoch: jnp.where(epoch < 100, 500 * 1e-2 ** (epoch / 100), 0.0)
    fit = vx.fit(problem, optax.adam(2e-2), 180, truth=truth, guidance=guidance, progress=False)
    assert mismatched_neighbours(fit.tissue, target) == 0
    assert np.max(np.abs(p0_of(fit.energy) / p0_of(truth) - 1)) < 1e-3
    assert fit.history.num_t1.sum() > 0
    # The best epoch must be one without guidance: guided epochs have smaller costs for any parameters.
    assert fit.best_epoch >= 100
    assert fit.history.cost[99] < fit.history.cost[100]


@pytest.mark.parametrize(
    "adjoint",
    [
        vx.ImplicitDifferentiation(),
        pytest.param(vx.EquilibriumPropagation(nudge="cost"), marks=pytest.mark.slow),
    ],
    ids=["ID", "EP"],
)
@pytest.mark.thorough
def test_guided_gradient_matches_finite_differences(adjoint):
    target, _ = relaxed(12, 3)
    guess = vx.energies.ShapeFactorEnergy(shape_factors(12, 3.7, 0.1, 5))
    tissue = FIXED_TOPOLOGY(target, guess).tissue
    cost = CentroidDistance(target)
    problem = vx.InverseProblem(
        tissue,
        guess,
        cost,
        response=FIXED_TOPOLOGY,
        adjoint=adjoint,
        guidance=3.0,
    )
    loss = lambda p0: problem(vx.energies.ShapeFactorEnergy(p0))[0]
    evaluate = jax.jit(jax.value_and_grad(loss))
    p0 = p0_of(problem.energy)
    direction = random_like(p0)
    value, gradient = evaluate(p0)
    slope = np.sum(np.asarray(gradient * direction))
    expected = float(central_difference(lambda p: evaluate(p)[0], p0, direction, 1e-4))
    accuracy = 1e-5 if isinstance(adjoint, vx.ImplicitDifferentiation) else 1e-3
    assert slope == pytest.approx(expected, rel=accuracy)
    # Guidance lowers the cost at fixed parameters.
    free = vx.InverseProblem(tissue, problem.energy, cost, response=FIXED_TOPOLOGY)
    assert value < 0.9 * float(free()[0])


def test_invalid_guidance_is_rejected():
    tissue = random_tissue(6)
    guess = vx.energies.ShapeFactorEnergy(jnp.full(6, 3.7))
    problem = vx.InverseProblem(tissue, guess, CentroidDistance(tissue), response=FIXED_TOPOLOGY)
    with pytest.raises(ValueError, match=r"`guidance` must return one number that is not negative"):
        vx.fit(problem, optax.adam(1e-2), 2, guidance=lambda epoch: -1.0, progress=False)
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    with pytest.raises(ValueError, match="`guidance` must be None for a least-squares solver"):
        vx.fit(problem, solver, 2, guidance=lambda epoch: 1.0, progress=False)
