"""All adjoints: the same interface, and the same gradient."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import (
    FIXED_TOPOLOGY,
    SOLVERS,
    central_difference,
    dense_hypergradient,
    random_like,
    random_tissue,
    relaxed,
    shape_factors,
)
from jaxtyping import Array, Float

import vertax as vx
from vertax.adjoints._propagation import RestoringForce
from vertax.costs import VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy

N_CELLS = 8  # in all tests, which then share compiled functions
SGD = vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))
FIXED_TOPOLOGY = FIXED_TOPOLOGY.traced()
MOMENTUM = dataclasses.replace(FIXED_TOPOLOGY, solver=SGD, max_steps=jnp.asarray(20_000))

# (name, adjoint, relaxation, tolerance of the relative error in float64)
ADJOINTS = [
    ("implicit", vx.ImplicitDifferentiation(), FIXED_TOPOLOGY, 1e-6),
    ("sensitivity", vx.ImplicitDifferentiation(mode="sensitivity"), FIXED_TOPOLOGY, 1e-6),
    ("propagation", vx.EquilibriumPropagation(), FIXED_TOPOLOGY, 1e-4),
    ("automatic", vx.AutomaticDifferentiation(), MOMENTUM, 1e-4),
]


def adjoints(*quick, thorough=()):
    """A parametrisation by all adjoints; those that are not named are marked as slow."""
    marks = dict.fromkeys(quick, ()) | dict.fromkeys(thorough, (pytest.mark.thorough,))
    return pytest.mark.parametrize(
        ("adjoint", "response", "rtol"),
        [
            pytest.param(*a[1:], marks=marks.get(a[0], (pytest.mark.slow,)), id=a[0])
            for a in ADJOINTS
        ],
    )


def distance(a, b) -> float:
    """Relative distance of two gradients, given as pytrees."""
    a, b = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(t)]) for t in (a, b))
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def inner(a, b) -> float:
    """Inner product of two pytrees."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return float(sum(np.sum(np.asarray(x) * np.asarray(y)) for x, y in pairs))


@functools.cache
def start_and_cost(n_cells=N_CELLS, seed=2):
    """A relaxed tissue, and a cost that pulls on all its vertices."""
    tissue, energy = relaxed(n_cells, seed)
    target = tissue.with_configuration(tissue.vertices + 0.05 * random_like(tissue.vertices, 7))
    return tissue, energy, 1.0 * VertexDistance(target)


class Evaluation(NamedTuple):
    cost: Array
    equilibrium: vx.Equilibrium
    gradient: Any
    by_box: Array
    outcome: vx.GradientOutcome


@eqx.filter_jit
def evaluate(tissue, energy, cost, adjoint, response):
    """The cost at equilibrium, and its derivatives by the energy and by the shape of the box."""

    def loss(arguments):
        energy, lattice, outcome = arguments
        strained = eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)
        equilibrium = response(strained, energy, adjoint=adjoint.with_outcome(outcome))
        return cost(equilibrium.tissue, energy), equilibrium

    at = (energy, tissue.boundary.lattice, vx.GradientOutcome())
    (value, equilibrium), slopes = eqx.filter_value_and_grad(loss, has_aux=True)(at)
    return Evaluation(value, equilibrium, *slopes)


@eqx.filter_jit
def plain_gradient(tissue, energy, cost, adjoint, response):
    """The gradient without its outcome."""
    loss = lambda e: cost(response(tissue, e, adjoint=adjoint).tissue, e)
    return eqx.filter_grad(loss)(energy)


@adjoints("implicit", thorough=("sensitivity", "propagation", "automatic"))
@pytest.mark.parametrize("n_cells", [N_CELLS, pytest.param(64, marks=pytest.mark.slow)])
def test_hypergradient_against_a_dense_reference(adjoint, response, rtol, n_cells):
    tissue, _, cost = start_and_cost(n_cells)
    guess = ShapeFactorEnergy(shape_factors(n_cells, 3.7, 0.1, 5))
    evaluation = evaluate(tissue, guess, cost, adjoint, response)
    reference = dense_hypergradient(evaluation.equilibrium.tissue, guess, cost)
    assert distance(evaluation.gradient, reference) < rtol


@adjoints("automatic")
@pytest.mark.thorough
def test_hypergradient_after_transitions(adjoint, response, rtol):
    _, _, cost = start_and_cost()
    tissue = random_tissue(N_CELLS, 5)
    energy = ShapeFactorEnergy(shape_factors(N_CELLS, 3.75, 0.1))
    response = dataclasses.replace(response, transitions=vx.T1())
    evaluation = evaluate(tissue, energy, cost, adjoint, response)
    assert evaluation.equilibrium.num_t1 > 0
    # Solvers may end in different minima, so the reference is computed at this one.
    reference = dense_hypergradient(evaluation.equilibrium.tissue, energy, cost)
    assert distance(evaluation.gradient, reference) < rtol


@adjoints("implicit", thorough=("sensitivity", "propagation", "automatic"))
def test_gradient_with_respect_to_the_shape_of_the_box(adjoint, response, rtol):
    tissue, energy, cost = start_and_cost()
    direction = 0.1 * random_like(tissue.boundary.lattice)

    def at(step):
        lattice = tissue.boundary.lattice + step * direction
        strained = eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)
        return evaluate(strained, energy, cost, adjoint, response)

    difference = (at(1e-5).cost - at(-1e-5).cost) / 2e-5
    assert inner(at(0.0).by_box, direction) == pytest.approx(float(difference), rel=10 * rtol)


class VertexSprings(vx.AbstractEnergy):
    """Springs of each vertex to a fixed point, with parameters per vertex."""

    stiffness: Float[Array, " vertices"]
    home: np.ndarray

    def __call__(self, tissue):
        return 0.5 * jnp.sum(self.stiffness * jnp.sum((tissue.vertices - self.home) ** 2, axis=1))


class NetworkEnergy(vx.AbstractEnergy):
    network: eqx.nn.MLP

    def __call__(self, tissue):
        shape = jnp.stack([tissue.areas, tissue.perimeters / 4], axis=-1)
        return ShapeFactorEnergy(3.6)(tissue) + 0.1 * jnp.sum(jax.vmap(self.network)(shape))


def energy_of_all_kinds(tissue):
    """Parameters per cell, per edge, per vertex, and of a neural network."""
    keys = jax.random.split(jax.random.key(0), 3)
    tension = 0.5 + 0.1 * jax.random.uniform(keys[0], (tissue.n_edges,))
    home = np.asarray(tissue.vertices + 0.05 * jax.random.normal(keys[1], tissue.vertices.shape))
    network = eqx.nn.MLP(2, "scalar", 8, 1, jnp.tanh, key=keys[2])
    return (
        AreaElasticity(20.0, jnp.linspace(0.9, 1.1, tissue.n_cells))
        + LineTension(tension)
        + VertexSprings(jnp.full(tissue.n_vertices, 0.5), home)
        + NetworkEnergy(network)
    )


class TotalCubes(vx.AbstractCost):
    def __call__(self, tissue, energy):
        return jnp.sum(tissue.areas**3) + jnp.sum(tissue.perimeters**3)


@pytest.mark.thorough
@adjoints("propagation")
def test_parameters_of_every_kind(adjoint, response, rtol):
    tissue, _, _ = start_and_cost()
    energy = energy_of_all_kinds(tissue)
    parameters, constants = eqx.partition(energy, eqx.is_inexact_array)
    at = lambda p: evaluate(tissue, eqx.combine(p, constants), TotalCubes(), adjoint, response)
    gradient, zeros = at(parameters).gradient, jax.tree.map(jnp.zeros_like, parameters)
    for i, term in enumerate(parameters.terms):
        direction = eqx.tree_at(lambda p, i=i: p.terms[i], zeros, random_like(term))
        difference = float(central_difference(lambda p: at(p).cost, parameters, direction))
        assert difference != 0
        assert inner(gradient, direction) == pytest.approx(difference, rel=max(10 * rtol, 1e-4))


@adjoints("propagation")
@pytest.mark.thorough
def test_vmap(adjoint, response, rtol):
    tissue, _, cost = start_and_cost()
    p0 = shape_factors(N_CELLS, 3.7, 0.1, 9)
    gradient = lambda p: evaluate(tissue, ShapeFactorEnergy(p), cost, adjoint, response).gradient
    batch = np.stack([p0, p0 + 0.02, p0 - 0.02])
    together = jax.vmap(gradient)(jnp.asarray(batch)).target_shape_factor
    for p, row in zip(batch, together, strict=True):
        assert distance(row, gradient(jnp.asarray(p))) < rtol


@adjoints("propagation")
@pytest.mark.thorough
def test_float32(adjoint, response, rtol):
    tissue, _, cost = start_and_cost()
    energy = ShapeFactorEnergy(shape_factors(N_CELLS, 3.7, 0.1, 4))
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    tissue_32, energy_32, cost_32 = jax.tree.map(to32, (tissue, energy, cost))
    gradient = evaluate(
        tissue_32, energy_32, cost_32, adjoint, response
    ).gradient.target_shape_factor
    assert gradient.dtype == jnp.float32
    reference = evaluate(
        tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
    ).gradient
    assert distance(gradient.astype(jnp.float64), reference) < 0.03


def solver_pairs():
    """Every adjoint with every compatible solver; most pairs are marked as slow."""
    quick = {("propagation", "lbfgs")}
    for adjoint_name, adjoint, _, rtol in ADJOINTS:
        for name, solver, reach in SOLVERS:
            if adjoint.unrolls and name not in ("gradient_descent", "optax_adam"):
                continue
            pair = adjoint_name, name
            mark = pytest.mark.thorough if pair in quick else pytest.mark.slow
            label = f"{adjoint_name}-{name}"
            yield pytest.param(adjoint, rtol, name, solver, reach, id=label, marks=mark)


@pytest.mark.parametrize(("adjoint", "rtol", "name", "solver", "reach"), list(solver_pairs()))
def test_gradient_with_every_compatible_solver(adjoint, rtol, name, solver, reach):
    tissue, _, cost = start_and_cost()
    energy = ShapeFactorEnergy(shape_factors(N_CELLS, 3.6, 0.1, 3))
    response = vx.Relaxation(solver, transitions=None, tolerance=10 * reach, max_steps=20_000)
    reference = evaluate(
        tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
    ).gradient
    if isinstance(adjoint, vx.EquilibriumPropagation):
        # The nudge must exceed the force at which the solver stalls.
        adjoint = vx.EquilibriumPropagation(beta=max(1e-5, reach), throw=False)
    gradient = evaluate(tissue, energy, cost, adjoint, response).gradient
    assert distance(gradient, reference) < max(rtol, 0.02 if reach > 1e-9 else 0)


def test_solvers_with_line_searches_are_not_unrolled():
    tissue, energy, _ = start_and_cost()
    with_line_search = [
        solver for name, solver, _ in SOLVERS if "adam" not in name and "descent" not in name
    ]
    for solver in (*with_line_search, optx.OptaxMinimiser(optax.lbfgs(), 0.0, 0.0)):
        with pytest.raises(ValueError, match=r"does not go with .*GradientDescent\(\)"):
            vx.equilibrate(tissue, energy, solver=solver, adjoint=vx.AutomaticDifferentiation())
    plain = optx.OptaxMinimiser(optax.sgd(1e-3), 0.0, 0.0)
    assert vx.solvers.Wrapped(plain).unrollable
    assert vx.solvers.Optax(optax.polyak_sgd()).unrollable


@pytest.mark.thorough
def test_unrolled_gradient_from_a_start_at_rest():
    at = start_and_cost()
    unrolled = evaluate(*at, vx.AutomaticDifferentiation(), MOMENTUM)
    assert unrolled.equilibrium.num_steps == 0
    assert (
        distance(
            unrolled.gradient, evaluate(*at, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY).gradient
        )
        < 1e-4
    )


def implicit_loss(mode):
    """A function of the shape factors of a few cells, its argument, and its gradient there."""
    tissue, _, cost = start_and_cost()
    adjoint = vx.ImplicitDifferentiation(mode=mode)

    def loss(p):
        e = ShapeFactorEnergy(p)
        equilibrium = vx.equilibrate(
            tissue, e, adjoint=adjoint, transitions=None, contact_range=None, tolerance=1e-12
        )
        return cost(equilibrium.tissue, e)

    p0 = shape_factors(N_CELLS, 3.65, 0.05, 1)
    gradient = evaluate(tissue, ShapeFactorEnergy(p0), cost, adjoint, FIXED_TOPOLOGY).gradient
    return loss, p0, gradient.target_shape_factor


@pytest.mark.parametrize("mode", ["adjoint", pytest.param("sensitivity", marks=pytest.mark.slow)])
@pytest.mark.thorough
def test_forward_mode(mode):
    loss, p0, gradient = implicit_loss(mode)
    assert distance(jax.jit(jax.jacfwd(loss))(p0), gradient) < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["adjoint", "sensitivity"])
def test_one_derivative_in_forward_mode(mode):
    loss, p0, gradient = implicit_loss(mode)
    direction = random_like(p0)
    along = jax.jit(lambda p, d: jax.jvp(loss, (p,), (d,))[1])
    assert along(p0, direction) == pytest.approx(inner(gradient, direction), rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["adjoint", "sensitivity"])
def test_second_derivatives(mode):
    loss, p0, _ = implicit_loss(mode)
    direction = random_like(p0)
    hessian = jax.jit(jax.hessian(loss))(p0)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-5, atol=1e-7)
    difference = central_difference(jax.jit(jax.grad(loss)), p0, direction)
    assert distance(hessian @ direction, difference) < 1e-5


@pytest.mark.slow
def test_adjoint_ignores_translations():
    # No parameter moves the centroid, so the gradient of a cost of the centroid is 0.
    tissue, energy, _ = start_and_cost()

    def loss(p):
        equilibrium = vx.equilibrate(
            tissue, ShapeFactorEnergy(p), transitions=None, contact_range=None, tolerance=1e-12
        )
        return jnp.sum(equilibrium.tissue.vertices)

    gradient = jax.jit(jax.grad(loss))(energy.target_shape_factor)
    assert jnp.abs(gradient).max() < 1e-8


@pytest.mark.slow
def test_order_of_the_estimators_of_equilibrium_propagation():
    tissue, energy, cost = start_and_cost()

    @eqx.filter_jit
    def gradient(adjoint):
        def loss(e):
            equilibrium = vx.equilibrate(
                tissue, e, adjoint=adjoint, transitions=None, contact_range=None, tolerance=1e-12
            )
            return cost(equilibrium.tissue, e)

        return jax.grad(loss)(energy)

    reference = gradient(vx.ImplicitDifferentiation())

    def error(beta, centred):
        adjoint = vx.EquilibriumPropagation(jnp.asarray(beta), centred=centred, rtol=1e-9)
        return distance(gradient(adjoint), reference)

    assert error(2e-4, True) / error(1e-4, True) == pytest.approx(4, rel=0.2)
    assert error(2e-4, False) / error(1e-4, False) == pytest.approx(2, rel=0.2)
    assert error(1e-4, True) < 0.1 * error(1e-4, False)


@pytest.mark.thorough
def test_default_nudge_is_independent_of_the_scale_of_the_cost():
    tissue, energy, cost = start_and_cost()
    for weight in (1e-9, 1.0, 1e9):
        estimate, exact = (
            evaluate(tissue, energy, weight * cost, adjoint, FIXED_TOPOLOGY).gradient
            for adjoint in (vx.EquilibriumPropagation(), vx.ImplicitDifferentiation())
        )
        assert distance(estimate, exact) < 1e-4


# A linear solver and a relaxation that stop before convergence.
TRUNCATED_MINRES = vx.MINRES(max_steps=3)
TRUNCATED_RELAXATION = eqx.tree_at(lambda r: r.max_steps, MOMENTUM, jnp.asarray(5))


class TestOutcome:
    """The diagnostics of a gradient, and the error for an unreliable one."""

    @adjoints(thorough=("propagation",))
    def test_outcome_is_returned_as_a_gradient(self, adjoint, response, rtol):
        evaluation = evaluate(*start_and_cost(), adjoint, response)
        assert evaluation.outcome.converged
        assert 0 < evaluation.outcome.residual < 1e-6
        assert evaluation.outcome.num_steps > 0
        # The outcome does not change the gradient.
        gradient = plain_gradient(*start_and_cost(), adjoint, response)
        assert distance(evaluation.gradient, gradient) < 1e-8

    @pytest.mark.parametrize(
        ("adjoint", "response"),
        [
            pytest.param(
                vx.ImplicitDifferentiation(linear_solver=TRUNCATED_MINRES),
                FIXED_TOPOLOGY,
                id="implicit",
            ),
            pytest.param(
                vx.ImplicitDifferentiation("sensitivity", linear_solver=TRUNCATED_MINRES),
                FIXED_TOPOLOGY,
                id="sensitivity",
                marks=pytest.mark.slow,
            ),
            pytest.param(
                vx.EquilibriumPropagation(),
                TRUNCATED_RELAXATION,
                id="propagation",
                marks=pytest.mark.slow,
            ),
            pytest.param(
                vx.AutomaticDifferentiation(),
                TRUNCATED_RELAXATION,
                id="automatic",
                marks=pytest.mark.thorough,
            ),
        ],
    )
    @pytest.mark.thorough
    def test_unreliable_gradient_raises(self, adjoint, response):
        tissue, energy, cost = start_and_cost()
        with pytest.raises(RuntimeError, match=r"cannot be trusted|maximum number of solver steps"):
            jax.block_until_ready(evaluate(tissue, energy, cost, adjoint, response))
        # The value of the cost is correct. With throw=False the gradient is returned, with failed = 1.
        assert np.isfinite(cost(response(tissue, energy, adjoint=adjoint).tissue, energy))
        without_error = eqx.tree_at(lambda a: a.throw, adjoint, False)
        evaluation = evaluate(tissue, energy, cost, without_error, response)
        assert np.isfinite(evaluation.gradient.target_shape_factor).all()
        assert not evaluation.outcome.converged

    def test_saddle_has_negative_curvature(self):
        # Regular hexagons with a target perimeter that is too long are an unstable equilibrium.
        tissue, (_, _, cost) = vx.initialise.hexagonal(2, 4), start_and_cost()
        for p0, is_saddle in ((3.9, True), (3.6, False)):
            energy = ShapeFactorEnergy(np.full(N_CELLS, p0))
            outcome = evaluate(
                tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
            ).outcome
            assert outcome.negative_curvature == is_saddle


@functools.cache
def fluid():
    """A fluid tissue: all areas and perimeters equal their targets, on a manifold of minima."""
    tissue, energy = relaxed(N_CELLS, 2, 4.1)
    assert energy(tissue) < 1e-18
    assert vx.mechanics.zero_modes(tissue, energy) > 2
    return tissue, energy, start_and_cost()[2]


class TestDegenerateEquilibrium:
    """Along motions without stiffness the equilibrium and costs of positions are not unique."""

    @pytest.mark.thorough
    @pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
    def test_gradient_of_a_cost_of_positions_is_rejected(self, adjoint):
        for function in (evaluate, plain_gradient):
            with pytest.raises(RuntimeError, match=r"equilibrium is not unique\..*zero_modes"):
                jax.block_until_ready(function(*fluid(), adjoint, FIXED_TOPOLOGY))

    @pytest.mark.parametrize(
        ("adjoint", "result"),
        [
            (vx.ImplicitDifferentiation(throw=False), vx.RESULTS.degenerate),
            pytest.param(
                vx.EquilibriumPropagation(throw=False),
                vx.RESULTS.nudge_not_linear,
                marks=pytest.mark.thorough,
            ),
        ],
    )
    @pytest.mark.thorough
    def test_outcome_is_degenerate(self, adjoint, result):
        outcome = evaluate(*fluid(), adjoint, FIXED_TOPOLOGY).outcome
        assert outcome.result == result
        assert not outcome.converged
        outcome = evaluate(*start_and_cost(), adjoint, FIXED_TOPOLOGY).outcome
        assert outcome.result == vx.RESULTS.successful
        assert outcome.converged

    @pytest.mark.thorough
    def test_gradient_of_a_cost_of_shapes_is_exact(self):
        tissue, energy, _ = fluid()
        evaluation = evaluate(
            tissue, energy, TotalCubes(), vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
        )
        # Each perimeter equals its target, so the derivative of the sum of cubes is 3 p0².
        expected = 3 * energy.target_shape_factor**2
        np.testing.assert_allclose(evaluation.gradient.target_shape_factor, expected, rtol=1e-6)
        assert evaluation.outcome.result != vx.RESULTS.degenerate


@pytest.mark.parametrize(
    ("power", "nonlinearity"), [(1, 0), (0, 1), (2, 0.5), (3, 0.75), (1.5, 1 - 0.5**0.5)]
)
def test_nonlinearity_of_a_power_law(power, nonlinearity):
    force = lambda y: jnp.where(y == 0, 0, jnp.abs(y) ** power)
    restoring = RestoringForce.along(force, jnp.zeros(1), jnp.full(1, 0.3))
    assert restoring.nonlinearity == pytest.approx(nonlinearity, abs=1e-12)
    assert RestoringForce.along(force, jnp.ones(1), jnp.ones(1)).nonlinearity == 0


class Touching(vx.AbstractCost):
    """-1 if two cells touch: a cost of the topology alone."""

    cells: tuple[int, int]

    def __call__(self, tissue, energy):
        pairs = jnp.sort(tissue.topology.edge_cells, axis=1)
        pair = jnp.asarray(sorted(self.cells))
        together = jnp.any(jnp.all(pairs == pair, axis=1))
        return jnp.where(together, -1.0, 0.0).astype(tissue.vertices.dtype)


value_and_gradient = eqx.filter_jit(lambda problem: problem.value_and_gradient())


class TestNudgeByTheCost:
    @pytest.mark.thorough
    def test_gradient_equals_that_of_implicit_differentiation(self):
        tissue, energy, cost = start_and_cost()
        adjoint = vx.EquilibriumPropagation(nudge="cost")
        problem = vx.InverseProblem(tissue, energy, cost, response=FIXED_TOPOLOGY, adjoint=adjoint)
        reference = evaluate(
            tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
        ).gradient
        by_cost = value_and_gradient(problem)
        assert by_cost.cost == pytest.approx(
            float(cost(by_cost.equilibrium.tissue, energy)), rel=1e-12
        )
        assert by_cost.outcome.converged
        assert distance(by_cost.gradient, reference) < 1e-4
        thrice = eqx.filter_jit(eqx.filter_grad(lambda e: 3 * problem(e)[0]))
        assert distance(thrice(energy), 3 * reference.target_shape_factor) < 1e-4

    @pytest.mark.slow
    def test_gradient_with_respect_to_a_fitted_position(self):
        tissue, energy, cost = start_and_cost()
        shift = jnp.array([0.1, -0.2])
        problem = vx.InverseProblem(
            tissue, energy, cost, adjoint=vx.EquilibriumPropagation(nudge="cost")
        )
        gradient = problem.value_and_gradient(shift=shift).shift_gradient
        plain = vx.InverseProblem(tissue, energy, cost)
        slope = jax.jit(jax.grad(lambda s: plain(shift=s)[0]))(shift)
        assert gradient is not None
        np.testing.assert_allclose(gradient, slope, rtol=1e-4)

    def test_cost_nudge_requires_an_inverse_problem(self):
        tissue, energy, _ = start_and_cost()
        with pytest.raises(ValueError, match="InverseProblem"):
            vx.equilibrate(tissue, energy, adjoint=vx.EquilibriumPropagation(nudge="cost"))

    @pytest.mark.thorough
    def test_cost_of_topology_has_a_gradient(self):
        # A cost of the topology has zero derivatives; only a nudge with transitions gives a gradient.
        tissue, energy = relaxed(N_CELLS, 2, 3.75)
        rule = vx.T1(threshold=0.4)
        tissue = vx.equilibrate(tissue, energy, transitions=rule, contact_range=None).tissue
        edge = int(jnp.argmin(tissue.edge_lengths))
        h = int(tissue.topology.half_edge[edge])
        m = tissue.topology
        ends = int(m.cell[m.twin[m.previous[h]]]), int(m.cell[m.twin[m.next[h]]])
        cost = Touching(ends)
        assert cost(tissue, energy) == 0
        slope = jax.grad(lambda x: cost(tissue.with_configuration(x), energy))(tissue.vertices)
        assert not slope.any()

        def gradient(beta):
            adjoint = vx.EquilibriumPropagation(nudge="cost", beta=jnp.asarray(beta))
            response = vx.Relaxation(transitions=rule, contact_range=None)
            problem = vx.InverseProblem(tissue, energy, cost, response=response, adjoint=adjoint)
            return value_and_gradient(problem).gradient.target_shape_factor

        assert not gradient(1e-6).any()  # too weak to flip
        steering = gradient(0.5)
        assert jnp.isfinite(steering).all()
        assert steering.any()


def test_invalid_arguments_raise():
    with pytest.raises(ValueError, match="`beta` must be positive"):
        vx.EquilibriumPropagation(beta=0.0)
    with pytest.raises(ValueError, match="`checkpoints` must be at least 1"):
        vx.AutomaticDifferentiation(checkpoints=0)
    with pytest.raises(ValueError, match="`rtol` must be positive"):
        vx.AutomaticDifferentiation(rtol=-1.0)


@pytest.mark.thorough
@adjoints("implicit")
def test_broken_member_of_a_batch_leaves_the_gradients_of_the_others(adjoint, response, rtol):
    tissue = random_tissue(N_CELLS)

    def loss(shift, offset):
        energy = ShapeFactorEnergy(jnp.full(N_CELLS, 3.6) + shift + offset)
        relaxed = response(tissue, energy, adjoint=adjoint, throw=False)
        return jnp.where(relaxed.converged, jnp.sum(relaxed.tissue.perimeters**2), 0)

    total = lambda shift, offsets: jnp.sum(jax.vmap(loss, (None, 0))(shift, offsets))
    valid, broken = jnp.array([0.0, 0.05]), jnp.array([0.0, jnp.nan, 0.05])
    zero = jnp.zeros(())
    expected = jax.grad(total)(zero, valid)
    np.testing.assert_allclose(jax.grad(total)(zero, broken), expected, rtol=10 * rtol)
