"""What all adjoints have in common: one line to differentiate, and one gradient."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import (
    SOLVERS,
    central_difference,
    dense_hypergradient,
    random_like,
    relaxed,
    shape_factors,
)
from jaxtyping import Array, Float

import vertax as vx
from vertax.costs import VertexDistance
from vertax.energies import AreaElasticity, LineTension, ShapeFactorEnergy

MOMENTUM = {"solver": vx.solvers.Optax(optax.sgd(3e-3, momentum=0.95, nesterov=True))}
UNROLLED = {**MOMENTUM, "max_steps": 20_000}

# (name, adjoint, options of equilibrate, relative error that it may have in float64)
ADJOINTS = [
    ("implicit", vx.ImplicitDifferentiation(), {}, 1e-6),
    ("sensitivity", vx.ImplicitDifferentiation(mode="sensitivity"), {}, 1e-6),
    ("propagation", vx.EquilibriumPropagation(), {}, 1e-4),
    ("automatic", vx.AutomaticDifferentiation(), UNROLLED, 1e-4),
]


def adjoints(*quick):
    """All adjoints, of which those named are tried on every change and all of them by `test-slow`."""
    return pytest.mark.parametrize(
        ("adjoint", "options", "rtol"),
        [
            pytest.param(*a[1:], marks=() if a[0] in quick else (pytest.mark.slow,), id=a[0])
            for a in ADJOINTS
        ],
    )


def distance(a, b) -> float:
    """Relative distance of two gradients, which are any pytrees."""
    a, b = (jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(t)]) for t in (a, b))
    return float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b))


@functools.cache
def start_and_cost(n_cells, seed=0):
    """A relaxed tissue, and a cost that pulls on all its vertices."""
    tissue, energy = relaxed(n_cells, seed)
    target = tissue.with_configuration(tissue.vertices + 0.05 * random_like(tissue.vertices, 7))
    return tissue, energy, VertexDistance(target)


@adjoints("implicit", "sensitivity", "propagation", "automatic")
@pytest.mark.parametrize("n_cells", [20, pytest.param(64, marks=pytest.mark.slow)])
def test_hypergradient_against_a_dense_reference(adjoint, options, rtol, n_cells):
    tissue, _energy, cost = start_and_cost(n_cells)
    guess = ShapeFactorEnergy(shape_factors(n_cells, 3.7, 0.1, 5))

    def loss(e):
        found = vx.equilibrate(
            tissue, e, adjoint=adjoint, transitions=None, tolerance=1e-10, **options
        )
        return cost(found.tissue, e)

    at = vx.equilibrate(tissue, guess, transitions=None, tolerance=1e-12).tissue
    reference = dense_hypergradient(at, guess, cost)
    assert distance(jax.jit(jax.grad(loss))(guess).target_shape_factor, reference) < rtol


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


def energies(tissue):
    """Parameters per cell, per edge, per vertex, and of a neural network."""
    n, keys = tissue.n_cells, jax.random.split(jax.random.key(0), 3)
    edges = AreaElasticity(20.0, 1.0) + LineTension(
        0.5 + 0.1 * jax.random.uniform(keys[0], (3 * n,))
    )
    home = np.asarray(tissue.vertices + 0.05 * jax.random.normal(keys[1], tissue.vertices.shape))
    vertices = ShapeFactorEnergy(3.6) + Tug(jnp.full(2 * n, 0.5), home)
    network = Learned(eqx.nn.MLP(2, "scalar", 8, 1, jnp.tanh, key=keys[2]))
    return {"edges": edges, "vertices": vertices, "network": network}


@adjoints("propagation")
@pytest.mark.parametrize(
    "which",
    [
        pytest.param("edges", marks=pytest.mark.slow),
        "vertices",
        "network",
    ],
)
def test_parameters_of_every_kind(adjoint, options, rtol, which):
    tissue, _ = relaxed(8, 3)
    energy = energies(tissue)[which]
    trainable, constants = eqx.partition(energy, eqx.is_inexact_array)

    def loss(p, adjoint=None, **options):
        e = eqx.combine(p, constants)
        found = vx.equilibrate(
            tissue, e, adjoint=adjoint, transitions=None, tolerance=1e-10, **options
        )
        return jnp.sum(found.tissue.areas**3) + jnp.sum(found.tissue.perimeters**3)

    gradient = eqx.filter_jit(jax.grad(loss))(trainable, adjoint, **options)
    direction = random_like(trainable)
    slope = sum(
        jnp.sum(g * d)
        for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    difference = central_difference(eqx.filter_jit(loss), trainable, direction)
    assert slope == pytest.approx(float(difference), rel=max(10 * rtol, 1e-4))


@adjoints("propagation", "automatic")
def test_topology_changes_on_the_way(adjoint, options, rtol):
    tissue = vx.initialise.periodic_voronoi(16, key=jax.random.key(5))
    p0 = shape_factors(16, 3.75, 0.1)

    def loss(p, adjoint=None, **options):
        found = vx.equilibrate(
            tissue, ShapeFactorEnergy(p), adjoint=adjoint, tolerance=1e-10, **options
        )
        return jnp.sum(found.tissue.perimeters**3), found

    gradient, found = eqx.filter_jit(jax.grad(loss, has_aux=True))(p0, adjoint, **options)
    assert found.num_t1 > 0
    # Solvers may end in different minima, so the reference is taken in this one.
    at = found.tissue

    def near(p):
        e = ShapeFactorEnergy(p)
        return jnp.sum(vx.equilibrate(at, e, transitions=None).tissue.perimeters ** 3)

    assert distance(gradient, jax.jit(jax.grad(near))(p0)) < rtol


@adjoints("propagation")
def test_vmap(adjoint, options, rtol):
    tissue, _, cost = start_and_cost(8, 2)
    p0 = shape_factors(8, 3.7, 0.1, 9)

    def loss(p):
        energy = ShapeFactorEnergy(p)
        found = vx.equilibrate(tissue, energy, adjoint=adjoint, transitions=None, **options)
        return cost(found.tissue, energy)

    gradient = jax.jit(jax.grad(loss))
    batch = jnp.stack([p0, p0 + 0.02, p0 - 0.02])
    together = jax.jit(jax.vmap(jax.grad(loss)))(batch)
    for p, row in zip(batch, together, strict=True):
        assert distance(row, gradient(p)) < rtol


@adjoints("propagation")
def test_float32(adjoint, options, rtol):
    tissue, _energy, cost = start_and_cost(12, 1)
    to32 = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    small, small_cost = jax.tree.map(to32, (tissue, cost))
    p0 = shape_factors(12, 3.7, 0.1, 4)

    def loss(p, tissue, cost, tolerance, adjoint=None, **options):
        e = ShapeFactorEnergy(p)
        found = vx.equilibrate(
            tissue, e, transitions=None, tolerance=tolerance, adjoint=adjoint, **options
        )
        return cost(found.tissue, e)

    gradient = eqx.filter_jit(jax.grad(loss))(
        p0.astype(jnp.float32), small, small_cost, 3e-5, adjoint, **options
    )
    assert gradient.dtype == jnp.float32
    reference = eqx.filter_jit(jax.grad(loss))(p0, tissue, cost, 1e-11)
    assert distance(gradient.astype(jnp.float64), reference) < 0.03


def solver_pairs():
    """Every adjoint with every solver; only some of the pairs are tried on every change."""
    quick = {("propagation", "lbfgs")}
    for adjoint_name, adjoint, _, rtol in ADJOINTS:
        for name, solver, reach in SOLVERS:
            if adjoint.unrolls and name not in ("gradient_descent", "optax_adam"):
                continue
            mark = () if (adjoint_name, name) in quick else (pytest.mark.slow,)
            label = f"{adjoint_name}-{name}"
            yield pytest.param(adjoint, rtol, name, solver, reach, id=label, marks=mark)


@pytest.mark.parametrize(("adjoint", "rtol", "name", "solver", "reach"), list(solver_pairs()))
def test_every_solver_that_an_adjoint_takes(adjoint, rtol, name, solver, reach):
    tissue, _, cost = start_and_cost(6, 1)
    energy = ShapeFactorEnergy(shape_factors(6, 3.6, 0.1, 3))

    def loss(e, solver, adjoint):
        found = vx.equilibrate(
            tissue,
            e,
            solver=solver,
            adjoint=adjoint,
            transitions=None,
            tolerance=10 * reach,
            max_steps=20_000,
        )
        return cost(found.tissue, e)

    gradient = eqx.filter_jit(jax.grad(loss))
    if isinstance(adjoint, vx.EquilibriumPropagation):
        # The nudge has to stand out from the force at which the solver stalls.
        adjoint = vx.EquilibriumPropagation(beta=max(1e-5, reach), throw=False)
    found = gradient(energy, solver, adjoint)
    reference = gradient(energy, vx.solvers.NewtonCG(), None)
    assert distance(found, reference) < max(rtol, 0.02 if reach > 1e-9 else 0)


def test_steps_with_decisions_are_not_unrolled():
    tissue, energy = relaxed(4, 1)
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
    tissue, energy, cost = start_and_cost(8)

    def loss(e, adjoint, **options):
        found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None, **options)
        return cost(found.tissue, e), found

    run = eqx.filter_jit(jax.grad(loss, has_aux=True))
    gradient, found = run(energy, vx.AutomaticDifferentiation(), **UNROLLED)
    assert found.num_steps == 0
    assert distance(gradient, run(energy, vx.ImplicitDifferentiation())[0]) < 1e-4


def implicit_loss(mode):
    """A function of the shape factors of a few cells, and where to differentiate it."""
    tissue, _, cost = start_and_cost(6, 2)
    adjoint = vx.ImplicitDifferentiation(mode=mode)

    def loss(p):
        e = ShapeFactorEnergy(p)
        found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None, tolerance=1e-12)
        return cost(found.tissue, e)

    return loss, shape_factors(6, 3.65, 0.05, 1)


@pytest.mark.parametrize("mode", ["adjoint", pytest.param("sensitivity", marks=pytest.mark.slow)])
def test_forward_mode(mode):
    loss, p0 = implicit_loss(mode)
    gradient = jax.jit(jax.grad(loss))(p0)
    assert distance(jax.jit(jax.jacfwd(loss))(p0), gradient) < 1e-7
    direction = random_like(p0)
    along = jax.jit(lambda p, d: jax.jvp(loss, (p,), (d,))[1])
    assert along(p0, direction) == pytest.approx(float(jnp.sum(gradient * direction)), rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["adjoint", "sensitivity"])
def test_second_derivatives(mode):
    loss, p0 = implicit_loss(mode)
    direction = random_like(p0)
    hessian = jax.jit(jax.hessian(loss))(p0)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-5, atol=1e-7)
    difference = central_difference(jax.jit(jax.grad(loss)), p0, direction)
    assert distance(hessian @ direction, difference) < 1e-5


@adjoints("implicit")
def test_gradient_with_respect_to_the_shape_of_the_box(adjoint, options, rtol):
    tissue, energy = relaxed(12, 4)
    strained = lambda lattice: eqx.tree_at(lambda t: t.boundary.lattice, tissue, lattice)

    def loss(lattice, adjoint=None, **options):
        found = vx.equilibrate(
            strained(lattice), energy, tolerance=1e-10, transitions=None, adjoint=adjoint, **options
        )
        return jnp.sum(found.tissue.perimeters**3)

    lattice = tissue.boundary.lattice
    direction = 0.1 * random_like(lattice)
    slope = jnp.sum(eqx.filter_jit(jax.grad(loss))(lattice, adjoint, **options) * direction)
    difference = central_difference(eqx.filter_jit(loss), lattice, direction)
    assert slope == pytest.approx(float(difference), rel=10 * rtol)


@pytest.mark.slow
def test_adjoint_ignores_translations():
    # A cost that pulls on the centroid alone has no gradient: no parameter moves the centroid.
    tissue, energy = relaxed(12, 1)

    def loss(p):
        found = vx.equilibrate(tissue, ShapeFactorEnergy(p), transitions=None, tolerance=1e-12)
        return jnp.sum(found.tissue.vertices)

    gradient = jax.jit(jax.grad(loss))(energy.target_shape_factor)
    assert jnp.abs(gradient).max() < 1e-8


@pytest.mark.slow
def test_order_of_the_estimators_of_equilibrium_propagation():
    tissue, energy, cost = start_and_cost(8)

    @eqx.filter_jit
    def gradient(adjoint):
        def loss(e):
            found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None, tolerance=1e-12)
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
    tissue, energy, cost = start_and_cost(8)

    @eqx.filter_jit
    def gradient(weight, adjoint):
        def loss(e):
            found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None)
            return (weight * cost)(found.tissue, e)

        return jax.grad(loss)(energy)

    for weight in map(jnp.asarray, (1e-9, 1.0, 1e9)):
        estimate = gradient(weight, vx.EquilibriumPropagation())
        assert distance(estimate, gradient(weight, vx.ImplicitDifferentiation())) < 1e-4


class TestOutcome:
    """How a gradient came about is told, and a bad one is refused."""

    def gradient(self, adjoint, tissue=None, **options):
        start, energy, cost = start_and_cost(8)
        start = start if tissue is None else tissue

        def loss(argument):
            energy, outcome = argument
            told = adjoint.with_outcome(outcome)
            found = vx.equilibrate(start, energy, adjoint=told, transitions=None, **options)
            return cost(found.tissue, energy)

        return jax.jit(jax.grad(loss))((energy, vx.GradientOutcome()))

    @adjoints("propagation")
    def test_it_is_the_gradient_with_respect_to_an_empty_one(self, adjoint, options, rtol):
        gradient, outcome = self.gradient(adjoint, **options)
        assert outcome.trusted
        assert 0 < outcome.residual < 1e-6
        assert outcome.num_steps > 0
        # Asking does not change the gradient.
        tissue, energy, cost = start_and_cost(8)

        def loss(e):
            found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None, **options)
            return cost(found.tissue, e)

        assert distance(gradient, jax.jit(jax.grad(loss))(energy)) < 1e-8

    @pytest.mark.parametrize(
        ("adjoint", "options"),
        [
            pytest.param(
                vx.ImplicitDifferentiation(linear_solver=vx.MINRES(max_steps=3)), {}, id="implicit"
            ),
            pytest.param(
                vx.ImplicitDifferentiation("sensitivity", linear_solver=vx.MINRES(max_steps=3)),
                {},
                id="sensitivity",
                marks=pytest.mark.slow,
            ),
            pytest.param(
                vx.EquilibriumPropagation(),
                {**MOMENTUM, "max_steps": 5},
                id="propagation",
                marks=pytest.mark.slow,
            ),
            pytest.param(
                vx.AutomaticDifferentiation(), {**MOMENTUM, "max_steps": 5}, id="automatic"
            ),
        ],
    )
    def test_a_gradient_that_cannot_be_trusted_is_refused(self, adjoint, options):
        tissue, energy, cost = start_and_cost(8)

        def loss(e, adjoint):
            found = vx.equilibrate(tissue, e, adjoint=adjoint, transitions=None, **options)
            return cost(found.tissue, e)

        gradient = eqx.filter_jit(eqx.filter_grad(loss))
        with pytest.raises(RuntimeError, match=r"cannot be trusted|maximum number of solver steps"):
            jax.block_until_ready(gradient(energy, adjoint))
        # The value itself is fine, and who insists gets the gradient, and is told.
        assert jnp.isfinite(loss(energy, adjoint))
        insisting = eqx.tree_at(lambda a: a.throw, adjoint, False)
        assert jnp.isfinite(gradient(energy, insisting).target_shape_factor).all()
        _, outcome = self.gradient(insisting, **options)
        assert not outcome.trusted

    def test_a_saddle_is_seen(self):
        # Regular hexagons of too long a target perimeter balance, but not stably.
        tissue = vx.initialise.hexagonal(3, 4)
        energy = ShapeFactorEnergy(jnp.full(tissue.n_cells, 3.9))
        target = tissue.with_configuration(tissue.vertices + random_like(tissue.vertices))

        def outcome_at(energy):
            def loss(argument):
                energy, outcome = argument
                adjoint = vx.ImplicitDifferentiation(outcome=outcome)
                found = vx.equilibrate(tissue, energy, adjoint=adjoint, transitions=None)
                return VertexDistance(target)(found.tissue, energy)

            return jax.jit(jax.grad(loss))((energy, vx.GradientOutcome()))[1]

        assert outcome_at(energy).negative_curvature == 1
        assert outcome_at(ShapeFactorEnergy(jnp.full(12, 3.6))).negative_curvature == 0


class Touching(vx.AbstractCost):
    """-1 if two cells touch: a cost of the topology alone."""

    cells: tuple[int, int]

    def __call__(self, tissue, energy):
        pairs = jnp.sort(tissue.topology.edge_cells, axis=1)
        wanted = jnp.asarray(sorted(self.cells))
        together = jnp.any(jnp.all(pairs == wanted, axis=1))
        return jnp.where(together, -1.0, 0.0).astype(tissue.vertices.dtype)


class TestNudgeByTheCost:
    def test_it_agrees_with_implicit_differentiation(self):
        tissue, energy, cost = start_and_cost(8)
        make = lambda adjoint: vx.InverseProblem(tissue, energy, cost, adjoint=adjoint)
        reference = make(vx.ImplicitDifferentiation()).value_and_gradient().gradient
        by_cost = make(vx.EquilibriumPropagation(nudge="cost")).value_and_gradient()
        assert by_cost.cost == cost(by_cost.equilibrium.tissue, energy)
        assert by_cost.outcome.trusted
        assert distance(by_cost.gradient, reference) < 1e-4
        thrice = lambda e: 3 * make(vx.EquilibriumPropagation(nudge="cost"))(e)[0]
        scaled = eqx.filter_jit(eqx.filter_grad(thrice))(energy)
        assert distance(scaled, 3 * reference.target_shape_factor) < 1e-4

    @pytest.mark.slow
    def test_a_fitted_position_has_its_gradient_too(self):
        tissue, energy, cost = start_and_cost(8)
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
        tissue, energy = relaxed(4, 1)
        with pytest.raises(ValueError, match="InverseProblem"):
            vx.equilibrate(tissue, energy, adjoint=vx.EquilibriumPropagation(nudge="cost"))

    def test_it_steers_topology(self):
        # A cost of the topology has no slope, so only a nudge that may flip edges can follow it.
        tissue, energy = relaxed(12, 4, 3.75)
        rule = vx.T1(threshold=0.4)
        tissue = vx.equilibrate(tissue, energy, transitions=rule).tissue
        edge = int(jnp.argmin(tissue.edge_lengths))
        h = int(tissue.topology.half_edge[edge])
        m = tissue.topology
        ends = int(m.cell[m.twin[m.previous[h]]]), int(m.cell[m.twin[m.next[h]]])
        cost = Touching(ends)
        assert cost(tissue, energy) == 0

        def gradient(**options):
            adjoint = vx.EquilibriumPropagation(**options)
            response = vx.Relaxation(transitions=rule)
            problem = vx.InverseProblem(tissue, energy, cost, response=response, adjoint=adjoint)
            return problem.value_and_gradient().gradient.target_shape_factor

        assert not gradient().any()
        assert not gradient(nudge="cost", beta=1e-6).any()  # too weak to flip
        steering = gradient(nudge="cost", beta=0.5)
        assert jnp.isfinite(steering).all()
        assert steering.any()


def test_bad_arguments():
    with pytest.raises(ValueError, match="`beta` must be positive"):
        vx.EquilibriumPropagation(beta=0.0)
    with pytest.raises(ValueError, match="`checkpoints` must be at least 1"):
        vx.AutomaticDifferentiation(checkpoints=0)
    with pytest.raises(ValueError, match="`rtol` must be positive"):
        vx.AutomaticDifferentiation(rtol=-1.0)
