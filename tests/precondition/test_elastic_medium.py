"""A preconditioner for large tissues: it changes how long a solution takes, and not the solution."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import vertax as vx
from vertax.precondition._edge_blocks import EdgeBlocks
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._preconditioned_minres import PreconditionedMINRES
from vertax.precondition._sum import Preconditioner
from vertax.relax._objective import preconditioner_of

pytestmark = pytest.mark.thorough

SIDE = 18
STIFFNESS = jnp.asarray(6.0)


def lattice(**arguments) -> vx.Tissue:
    return vx.initialise.hexagonal(SIDE, SIDE, **arguments)


def waves_of(tissue: vx.Tissue) -> ElasticMedium:
    waves = ElasticMedium.of(tissue)
    assert waves is not None
    return waves


def random_vectors(seed: int, tissue: vx.Tissue, n: int = 2) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(n, tissue.n_vertices, 2)))


def pinned() -> vx.Tissue:
    tissue = lattice()
    return eqx.tree_at(
        lambda t: t.pinned,
        tissue,
        jnp.arange(tissue.n_vertices) % 7 == 0,
        is_leaf=lambda x: x is None,
    )


def test_small_tissues_have_none():
    assert vx.initialise.hexagonal(4, 4).n_cells < ElasticMedium.min_cells
    assert ElasticMedium.of(vx.initialise.hexagonal(4, 4)) is None


def test_smallest_preconditioned_tissue_is_set_in_one_place(monkeypatch):
    # The benchmark of large tissues changes it: every user of the number has to see that.
    tissue, energy = vx.initialise.hexagonal(4, 4), vx.energies.ShapeFactorEnergy(3.7)
    assert preconditioner_of(tissue, energy, None).coarse is None
    monkeypatch.setattr(ElasticMedium, "min_cells", tissue.n_cells)
    assert ElasticMedium.of(tissue) is not None
    assert preconditioner_of(tissue, energy, None).coarse is not None


@pytest.mark.parametrize("curvature", [3.0, -3.0])
@pytest.mark.parametrize(
    "tissue",
    [
        lattice(),
        pinned(),
        lattice().with_capacity(SIDE**2 + 5),
        vx.initialise.free_voronoi(ElasticMedium.min_cells, key=0),
    ],
    ids=["periodic", "pinned", "spare slots", "free"],
)
def test_it_is_symmetric_and_positive_whatever_the_hessian(tissue, curvature):
    waves = waves_of(tissue)
    hessian = lambda v: jax.tree.map(lambda x: curvature * x, v)
    medium = waves.set_up(hessian, tissue.configuration, STIFFNESS)
    a, b = random_vectors(0, tissue)
    compliance = waves.approximate_inverse(medium, 0.1)
    yields = jax.jit(lambda f: compliance(f))
    np.testing.assert_allclose(jnp.vdot(a, yields(b)), jnp.vdot(b, yields(a)), rtol=1e-9)
    for seed in range(1, 5):
        for f in random_vectors(seed, tissue):
            assert jnp.vdot(f, yields(f)) > 0
    if tissue.held is not None:
        assert jnp.all(yields(a)[tissue.held] == 0)


@pytest.fixture(scope="module")
def crystal():
    """A lattice at rest, products with its Hessian, and both solvers."""
    tissue = lattice()
    energy = vx.energies.ShapeFactorEnergy(3.6)
    force = lambda y, _: jax.grad(lambda y: energy(tissue.with_configuration(y)))(y)
    plain = vx.solvers.MINRES()
    edges = EdgeBlocks.of(tissue, energy)
    elastic = PreconditionedMINRES(plain, Preconditioner(edges, waves_of(tissue)), STIFFNESS)

    @eqx.filter_jit
    def solve(rhs, solver):
        operator = lx.JacobianLinearOperator(force, tissue.vertices, None, tags=lx.symmetric_tag)
        solution = lx.linear_solve(operator, rhs, solver, throw=False)
        return solution.value, solution.stats["num_steps"], solution.stats["inconsistent"]

    return tissue, solve, plain, elastic


def test_a_system_takes_fewer_steps_to_the_same_solution(crystal):
    tissue, solve, plain, elastic = crystal
    rhs = random_vectors(3, tissue)[0]
    rhs = rhs - jnp.mean(rhs, axis=0)
    expected, steps, _ = solve(rhs, plain)
    result, fewer, _ = solve(rhs, elastic)
    centred = lambda x: x - jnp.mean(x, axis=0)
    np.testing.assert_allclose(
        centred(result), centred(expected), atol=1e-8 * float(jnp.abs(expected).max())
    )
    assert fewer < 0.5 * steps


def test_an_inconsistent_system_is_solved_without_it(crystal):
    tissue, solve, plain, elastic = crystal
    rhs = random_vectors(4, tissue)[0] + 1.0  # A lattice resists no shift of the whole.
    expected, _, without = solve(rhs, plain)
    result, _, still_without = solve(rhs, elastic)
    assert without
    assert still_without
    np.testing.assert_allclose(result, expected, atol=1e-8 * float(jnp.abs(expected).max()))


@pytest.mark.slow
def test_a_gradient_in_a_large_tissue_is_that_of_the_dense_hessian():
    n = 400
    factors = 3.65 + 0.05 * jax.random.normal(jax.random.key(1), (n,))
    energy_of = vx.energies.ShapeFactorEnergy
    begin = vx.initialise.periodic_voronoi(n, key=0)
    start = vx.equilibrate(begin, energy_of(factors)).tissue
    target = start.with_vertices(start.vertices + 0.01 * random_vectors(5, start)[0])
    cost = vx.costs.VertexDistance(target)

    def loss(p):
        relaxed = vx.equilibrate(start, energy_of(p), tolerance=1e-12, transitions=None).tissue
        return cost(relaxed, energy_of(p))

    gradient = jax.jit(jax.grad(loss))(factors)
    flat = start.vertices.ravel()
    energy = lambda x, p: energy_of(p)(start.with_configuration(x.reshape(-1, 2)))
    hessian = jax.jit(jax.hessian(energy))(flat, factors)
    mixed = jax.jit(jax.jacfwd(jax.grad(energy), argnums=1))(flat, factors)
    misfit = lambda x: cost(start.with_configuration(x.reshape(-1, 2)), energy_of(factors))
    dense = -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ jax.grad(misfit)(flat)
    assert jnp.linalg.norm(gradient - dense) < 1e-6 * jnp.linalg.norm(dense)


@pytest.mark.slow
def test_a_gradient_with_arcs_is_that_of_a_factorisation():
    """Bulges are unknowns as well, and have no waves; edges that bend have no blocks."""
    start = vx.initialise.free_voronoi(ElasticMedium.min_cells, key=1)
    tensions = jax.random.uniform(jax.random.key(2), (start.n_edges,), minval=0.9, maxval=1.1)
    energy_of = lambda g: vx.energies.AreaElasticity(20.0, 1.0) + vx.energies.LineTension(g)
    start = vx.equilibrate(start, energy_of(tensions)).tissue
    assert start.arcs is not None
    target = start.with_vertices(start.vertices + 0.01 * random_vectors(5, start)[0])
    cost = vx.costs.VertexDistance(target)

    def gradient(solver):
        adjoint = vx.adjoints.ImplicitDifferentiation(linear_solver=solver)

        def loss(g):
            relaxed = vx.equilibrate(start, energy_of(g), tolerance=1e-11, adjoint=adjoint)
            return cost(relaxed.tissue, energy_of(g))

        return jax.jit(jax.grad(loss))(tensions)

    expected = gradient(vx.solvers.Direct())
    result = gradient(vx.solvers.MINRES())
    assert jnp.linalg.norm(result - expected) < 1e-6 * jnp.linalg.norm(expected)
