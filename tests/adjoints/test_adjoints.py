"""What all adjoints have in common: one line to differentiate, and one gradient."""

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
from vertax.adjoints._propagation import Resistance
from vertax.costs import VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy

CELLS = 8  # in all tests, which share what is compiled for them
SGD = vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))
FIXED_TOPOLOGY = FIXED_TOPOLOGY.traced()
MOMENTUM = dataclasses.replace(FIXED_TOPOLOGY, solver=SGD, max_steps=jnp.asarray(20_000))

# (name, adjoint, how to relax, relative error that it may have in float64)
ADJOINTS = [
    ("implicit", vx.ImplicitDifferentiation(), FIXED_TOPOLOGY, 1e-6),
    ("sensitivity", vx.ImplicitDifferentiation(mode="sensitivity"), FIXED_TOPOLOGY, 1e-6),
    ("propagation", vx.EquilibriumPropagation(), FIXED_TOPOLOGY, 1e-4),
    ("automatic", vx.AutomaticDifferentiation(), MOMENTUM, 1e-4),
]


def adjoints(*quick):
    """All adjoints, of which those named are tried on every change and all of them by `test-slow`."""
    return pytest.mark.parametrize(
        ("adjoint", "response", "rtol"),
        [
            pytest.param(*a[1:], marks=() if a[0] in quick else (pytest.mark.slow,), id=a[0])
            for a in ADJOINTS
        ],
    )


def distance(a, b) -> float:
    """Relative distance of two gradients, which are any pytrees."""
    a, b = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(t)]) for t in (a, b))
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def inner(a, b) -> float:
    """Inner product of two pytrees."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return float(sum(np.sum(np.asarray(x) * np.asarray(y)) for x, y in pairs))


@functools.cache
def start_and_cost(n_cells=CELLS, seed=2):
    """A relaxed tissue, and a cost that pulls on all its vertices."""
    tissue, energy = relaxed(n_cells, seed)
    target = tissue.with_configuration(tissue.vertices + 0.05 * random_like(tissue.vertices, 7))
    return tissue, energy, 1.0 * VertexDistance(target)


class Evaluation(NamedTuple):
    cost: Array
    found: vx.Equilibrium
    gradient: Any
    by_box: Array
    outcome: vx.GradientOutcome


@eqx.filter_jit
def evaluate(tissue, energy, cost, adjoint, response):
    """The cost at equilibrium, with its derivatives by the energy and by the shape of the box."""

    def loss(arguments):
        energy, lattice, outcome = arguments
        strained = eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)
        found = response(strained, energy, adjoint=adjoint.with_outcome(outcome))
        return cost(found.tissue, energy), found

    at = (energy, tissue.boundary.lattice, vx.GradientOutcome())
    (value, found), slopes = eqx.filter_value_and_grad(loss, has_aux=True)(at)
    return Evaluation(value, found, *slopes)


@eqx.filter_jit
def plain_gradient(tissue, energy, cost, adjoint, response):
    """The gradient, of which nobody asks how it came about."""
    loss = lambda e: cost(response(tissue, e, adjoint=adjoint).tissue, e)
    return eqx.filter_grad(loss)(energy)


@adjoints("implicit", "sensitivity", "propagation", "automatic")
@pytest.mark.parametrize("n_cells", [CELLS, pytest.param(64, marks=pytest.mark.slow)])
def test_hypergradient_against_a_dense_reference(adjoint, response, rtol, n_cells):
    tissue, _, cost = start_and_cost(n_cells)
    guess = ShapeFactorEnergy(shape_factors(n_cells, 3.7, 0.1, 5))
    found = evaluate(tissue, guess, cost, adjoint, response)
    reference = dense_hypergradient(found.found.tissue, guess, cost)
    assert distance(found.gradient, reference) < rtol


@adjoints("automatic")
@pytest.mark.thorough
def test_topology_changes_on_the_way(adjoint, response, rtol):
    _, _, cost = start_and_cost()
    tissue = random_tissue(CELLS, 5)
    energy = ShapeFactorEnergy(shape_factors(CELLS, 3.75, 0.1))
    response = dataclasses.replace(response, transitions=vx.T1())
    found = evaluate(tissue, energy, cost, adjoint, response)
    assert found.found.num_t1 > 0
    # Solvers may end in different minima, so the reference is taken in this one.
    assert distance(found.gradient, dense_hypergradient(found.found.tissue, energy, cost)) < rtol


@adjoints("implicit", "sensitivity", "propagation", "automatic")
def test_gradient_with_respect_to_the_shape_of_the_box(adjoint, response, rtol):
    tissue, energy, cost = start_and_cost()
    direction = 0.1 * random_like(tissue.boundary.lattice)

    def at(step):
        lattice = tissue.boundary.lattice + step * direction
        strained = eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)
        return evaluate(strained, energy, cost, adjoint, response)

    difference = (at(1e-5).cost - at(-1e-5).cost) / 2e-5
    assert inner(at(0.0).by_box, direction) == pytest.approx(float(difference), rel=10 * rtol)


class Tug(vx.AbstractEnergy):
    """Springs of each vertex to where it once was: parameters per vertex."""

    stiffness: Float[Array, " vertices"]
    home: np.ndarray

    def __call__(self, tissue):
        return 0.5 * jnp.sum(self.stiffness * jnp.sum((tissue.vertices - self.home) ** 2, axis=1))


class Learned(vx.AbstractEnergy):
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
        + Tug(jnp.full(tissue.n_vertices, 0.5), home)
        + Learned(network)
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
    gradient, none = at(parameters).gradient, jax.tree.map(jnp.zeros_like, parameters)
    for i, term in enumerate(parameters.terms):
        direction = eqx.tree_at(lambda p, i=i: p.terms[i], none, random_like(term))
        difference = float(central_difference(lambda p: at(p).cost, parameters, direction))
        assert difference != 0
        assert inner(gradient, direction) == pytest.approx(difference, rel=max(10 * rtol, 1e-4))


@adjoints("propagation")
@pytest.mark.thorough
def test_vmap(adjoint, response, rtol):
    tissue, _, cost = start_and_cost()
    p0 = shape_factors(CELLS, 3.7, 0.1, 9)
    gradient = lambda p: evaluate(tissue, ShapeFactorEnergy(p), cost, adjoint, response).gradient
    batch = np.stack([p0, p0 + 0.02, p0 - 0.02])
    together = jax.vmap(gradient)(jnp.asarray(batch)).target_shape_factor
    for p, row in zip(batch, together, strict=True):
        assert distance(row, gradient(jnp.asarray(p))) < rtol


@adjoints("propagation")
@pytest.mark.thorough
def test_float32(adjoint, response, rtol):
    tissue, _, cost = start_and_cost()
    energy = ShapeFactorEnergy(shape_factors(CELLS, 3.7, 0.1, 4))
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
    """Every adjoint with every solver; only some of the pairs are tried on every change."""
    often = {("propagation", "lbfgs")}
    for adjoint_name, adjoint, _, rtol in ADJOINTS:
        for name, solver, reach in SOLVERS:
            if adjoint.unrolls and name not in ("gradient_descent", "optax_adam"):
                continue
            pair = adjoint_name, name
            mark = pytest.mark.thorough if pair in often else pytest.mark.slow
            label = f"{adjoint_name}-{name}"
            yield pytest.param(adjoint, rtol, name, solver, reach, id=label, marks=mark)


@pytest.mark.parametrize(("adjoint", "rtol", "name", "solver", "reach"), list(solver_pairs()))
def test_every_solver_that_an_adjoint_takes(adjoint, rtol, name, solver, reach):
    tissue, _, cost = start_and_cost()
    energy = ShapeFactorEnergy(shape_factors(CELLS, 3.6, 0.1, 3))
    response = vx.Relaxation(solver, transitions=None, tolerance=10 * reach, max_steps=20_000)
    reference = evaluate(
        tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
    ).gradient
    if isinstance(adjoint, vx.EquilibriumPropagation):
        # The nudge has to stand out from the force at which the solver stalls.
        adjoint = vx.EquilibriumPropagation(beta=max(1e-5, reach), throw=False)
    found = evaluate(tissue, energy, cost, adjoint, response).gradient
    assert distance(found, reference) < max(rtol, 0.02 if reach > 1e-9 else 0)


def test_steps_with_decisions_are_not_unrolled():
    tissue, energy, _ = start_and_cost()
    refused = [
        solver for name, solver, _ in SOLVERS if "adam" not in name and "descent" not in name
    ]
    for solver in (*refused, optx.OptaxMinimiser(optax.lbfgs(), 0.0, 0.0)):
        with pytest.raises(ValueError, match=r"does not go with .*GradientDescent\(\)"):
            vx.equilibrate(tissue, energy, solver=solver, adjoint=vx.AutomaticDifferentiation())
    plain = optx.OptaxMinimiser(optax.sgd(1e-3), 0.0, 0.0)
    assert vx.solvers.Wrapped(plain).unrollable
    assert vx.solvers.Optax(optax.polyak_sgd()).unrollable


def test_an_unrolled_relaxation_that_starts_at_rest_still_has_a_gradient():
    at = start_and_cost()
    unrolled = evaluate(*at, vx.AutomaticDifferentiation(), MOMENTUM)
    assert unrolled.found.num_steps == 0
    assert (
        distance(
            unrolled.gradient, evaluate(*at, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY).gradient
        )
        < 1e-4
    )


def implicit_loss(mode):
    """A function of the shape factors of a few cells, where to differentiate it, and its gradient."""
    tissue, _, cost = start_and_cost()
    adjoint = vx.ImplicitDifferentiation(mode=mode)

    def loss(p):
        e = ShapeFactorEnergy(p)
        found = vx.equilibrate(
            tissue, e, adjoint=adjoint, transitions=None, contact_range=None, tolerance=1e-12
        )
        return cost(found.tissue, e)

    p0 = shape_factors(CELLS, 3.65, 0.05, 1)
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
    # A cost that pulls on the centroid alone has no gradient: no parameter moves the centroid.
    tissue, energy, _ = start_and_cost()

    def loss(p):
        found = vx.equilibrate(
            tissue, ShapeFactorEnergy(p), transitions=None, contact_range=None, tolerance=1e-12
        )
        return jnp.sum(found.tissue.vertices)

    gradient = jax.jit(jax.grad(loss))(energy.target_shape_factor)
    assert jnp.abs(gradient).max() < 1e-8


@pytest.mark.slow
def test_order_of_the_estimators_of_equilibrium_propagation():
    tissue, energy, cost = start_and_cost()

    @eqx.filter_jit
    def gradient(adjoint):
        def loss(e):
            found = vx.equilibrate(
                tissue, e, adjoint=adjoint, transitions=None, contact_range=None, tolerance=1e-12
            )
            return cost(found.tissue, e)

        return jax.grad(loss)(energy)

    reference = gradient(vx.ImplicitDifferentiation())

    def error(beta, centred):
        adjoint = vx.EquilibriumPropagation(jnp.asarray(beta), centred=centred, rtol=1e-9)
        return distance(gradient(adjoint), reference)

    assert error(2e-4, True) / error(1e-4, True) == pytest.approx(4, rel=0.2)
    assert error(2e-4, False) / error(1e-4, False) == pytest.approx(2, rel=0.2)
    assert error(1e-4, True) < 0.1 * error(1e-4, False)


def test_one_default_nudge_suits_costs_of_any_size():
    tissue, energy, cost = start_and_cost()
    for weight in (1e-9, 1.0, 1e9):
        estimate, exact = (
            evaluate(tissue, energy, weight * cost, adjoint, FIXED_TOPOLOGY).gradient
            for adjoint in (vx.EquilibriumPropagation(), vx.ImplicitDifferentiation())
        )
        assert distance(estimate, exact) < 1e-4


# A linear solver, and relaxations, that are cut short.
HASTY = vx.MINRES(max_steps=3)
RASH = eqx.tree_at(lambda r: r.max_steps, MOMENTUM, jnp.asarray(5))


class TestOutcome:
    """How a gradient came about is told, and a bad one is refused."""

    @adjoints("propagation")
    def test_it_is_the_gradient_with_respect_to_an_empty_one(self, adjoint, response, rtol):
        found = evaluate(*start_and_cost(), adjoint, response)
        assert found.outcome.trusted
        assert 0 < found.outcome.residual < 1e-6
        assert found.outcome.num_steps > 0
        # Asking does not change the gradient.
        gradient = plain_gradient(*start_and_cost(), adjoint, response)
        assert distance(found.gradient, gradient) < 1e-8

    @pytest.mark.parametrize(
        ("adjoint", "response"),
        [
            pytest.param(
                vx.ImplicitDifferentiation(linear_solver=HASTY), FIXED_TOPOLOGY, id="implicit"
            ),
            pytest.param(
                vx.ImplicitDifferentiation("sensitivity", linear_solver=HASTY),
                FIXED_TOPOLOGY,
                id="sensitivity",
                marks=pytest.mark.slow,
            ),
            pytest.param(
                vx.EquilibriumPropagation(), RASH, id="propagation", marks=pytest.mark.slow
            ),
            pytest.param(
                vx.AutomaticDifferentiation(), RASH, id="automatic", marks=pytest.mark.thorough
            ),
        ],
    )
    @pytest.mark.thorough
    def test_a_gradient_that_cannot_be_trusted_is_refused(self, adjoint, response):
        tissue, energy, cost = start_and_cost()
        with pytest.raises(RuntimeError, match=r"cannot be trusted|maximum number of solver steps"):
            jax.block_until_ready(evaluate(tissue, energy, cost, adjoint, response))
        # The value itself is fine, and who insists gets the gradient, and is told.
        assert np.isfinite(cost(response(tissue, energy, adjoint=adjoint).tissue, energy))
        insisting = eqx.tree_at(lambda a: a.throw, adjoint, False)
        found = evaluate(tissue, energy, cost, insisting, response)
        assert np.isfinite(found.gradient.target_shape_factor).all()
        assert not found.outcome.trusted

    def test_a_saddle_is_seen(self):
        # Regular hexagons of too long a target perimeter balance, but not stably.
        tissue, (_, _, cost) = vx.initialise.hexagonal(2, 4), start_and_cost()
        for p0, is_saddle in ((3.9, True), (3.6, False)):
            energy = ShapeFactorEnergy(np.full(CELLS, p0))
            outcome = evaluate(
                tissue, energy, cost, vx.ImplicitDifferentiation(), FIXED_TOPOLOGY
            ).outcome
            assert outcome.negative_curvature == is_saddle


@functools.cache
def fluid():
    """A tissue whose cells have all they want: areas and perimeters are those asked for in a flat valley."""
    tissue, energy = relaxed(CELLS, 2, 4.1)
    assert energy(tissue) < 1e-18
    assert vx.mechanics.zero_modes(tissue, energy) > 2
    return tissue, energy, start_and_cost()[2]


class TestDegenerateEquilibrium:
    """Along motions without stiffness an equilibrium is not unique, and neither is a cost of positions."""

    @pytest.mark.parametrize("adjoint", [vx.ImplicitDifferentiation(), vx.EquilibriumPropagation()])
    def test_gradient_of_a_cost_of_positions_is_rejected(self, adjoint):
        for function in (evaluate, plain_gradient):
            with pytest.raises(RuntimeError, match=r"equilibrium is not unique\..*zero_modes"):
                jax.block_until_ready(function(*fluid(), adjoint, FIXED_TOPOLOGY))

    @pytest.mark.parametrize(
        "adjoint",
        [
            vx.ImplicitDifferentiation(throw=False),
            pytest.param(vx.EquilibriumPropagation(throw=False), marks=pytest.mark.thorough),
        ],
    )
    def test_outcome_reports_it(self, adjoint):
        outcome = evaluate(*fluid(), adjoint, FIXED_TOPOLOGY).outcome
        assert outcome.degenerate == 1
        assert not outcome.trusted
        outcome = evaluate(*start_and_cost(), adjoint, FIXED_TOPOLOGY).outcome
        assert outcome.degenerate == 0
        assert outcome.trusted

    def test_gradient_of_a_cost_of_shapes_is_exact(self):
        tissue, energy, _ = fluid()
        found = evaluate(tissue, energy, TotalCubes(), vx.ImplicitDifferentiation(), FIXED_TOPOLOGY)
        # Each perimeter is its target: the derivative of the sum of cubes is 3 p0².
        expected = 3 * energy.target_shape_factor**2
        np.testing.assert_allclose(found.gradient.target_shape_factor, expected, rtol=1e-6)
        assert found.outcome.degenerate == 0


@pytest.mark.parametrize(
    ("power", "nonlinearity"), [(1, 0), (0, 1), (2, 0.5), (3, 0.75), (1.5, 1 - 0.5**0.5)]
)
def test_nonlinearity_of_a_power_law(power, nonlinearity):
    force = lambda y: jnp.where(y == 0, 0, jnp.abs(y) ** power)
    along = Resistance.along(force, jnp.zeros(1), jnp.full(1, 0.3))
    assert along.nonlinearity == pytest.approx(nonlinearity, abs=1e-12)
    assert Resistance.along(force, jnp.ones(1), jnp.ones(1)).nonlinearity == 0


class Touching(vx.AbstractCost):
    """-1 if two cells touch: a cost of the topology alone."""

    cells: tuple[int, int]

    def __call__(self, tissue, energy):
        pairs = jnp.sort(tissue.topology.edge_cells, axis=1)
        wanted = jnp.asarray(sorted(self.cells))
        together = jnp.any(jnp.all(pairs == wanted, axis=1))
        return jnp.where(together, -1.0, 0.0).astype(tissue.vertices.dtype)


value_and_gradient = eqx.filter_jit(lambda problem: problem.value_and_gradient())


class TestNudgeByTheCost:
    @pytest.mark.thorough
    def test_it_agrees_with_implicit_differentiation(self):
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
        assert by_cost.outcome.trusted
        assert distance(by_cost.gradient, reference) < 1e-4
        thrice = eqx.filter_jit(eqx.filter_grad(lambda e: 3 * problem(e)[0]))
        assert distance(thrice(energy), 3 * reference.target_shape_factor) < 1e-4

    @pytest.mark.slow
    def test_a_fitted_position_has_its_gradient_too(self):
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

    def test_it_needs_to_know_the_cost(self):
        tissue, energy, _ = start_and_cost()
        with pytest.raises(ValueError, match="InverseProblem"):
            vx.equilibrate(tissue, energy, adjoint=vx.EquilibriumPropagation(nudge="cost"))

    @pytest.mark.thorough
    def test_it_steers_topology(self):
        # A cost of the topology has no slope, so only a nudge that may flip edges can follow it.
        tissue, energy = relaxed(CELLS, 2, 3.75)
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


def test_bad_arguments():
    with pytest.raises(ValueError, match="`beta` must be positive"):
        vx.EquilibriumPropagation(beta=0.0)
    with pytest.raises(ValueError, match="`checkpoints` must be at least 1"):
        vx.AutomaticDifferentiation(checkpoints=0)
    with pytest.raises(ValueError, match="`rtol` must be positive"):
        vx.AutomaticDifferentiation(rtol=-1.0)
