"""Many right-hand sides: one factorisation for all, or none at all."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue, shape_factors

import vertax as vx
from vertax.energies import ShapeFactorEnergy
from vertax.solvers import Direct

N = 9


def test_a_singular_indefinite_matrix():
    basis = jnp.linalg.qr(jax.random.normal(jax.random.key(0), (8, 8)))[0]
    values = jnp.array([-2.0, -0.1, 0.0, 0.0, 0.3, 1.0, 5.0, 20.0])
    matrix = (basis * values) @ basis.T
    many = matrix @ jax.random.normal(jax.random.key(1), (8, 5))
    operator = lx.MatrixLinearOperator(matrix, lx.symmetric_tag)
    solve = lambda b: lx.linear_solve(operator, b, Direct()).value
    result = jax.jit(jax.vmap(solve, in_axes=1, out_axes=1))(many)
    np.testing.assert_allclose(result, jnp.linalg.pinv(matrix) @ many, atol=2e-6)


def test_derivative_of_a_singular_system_whose_null_space_is_fixed():
    basis = jnp.linalg.qr(jax.random.normal(jax.random.key(0), (8, 8)))[0]
    values = jnp.array([-2.0, -0.1, 0.0, 0.0, 0.3, 1.0, 5.0, 20.0])
    growth, c = jnp.arange(8) / 8, jax.random.normal(jax.random.key(1), (8,))

    @eqx.filter_jit
    def solve(t):
        matrix = (basis * values * (1 + t * growth)) @ basis.T
        operator = lx.MatrixLinearOperator(matrix, lx.symmetric_tag)
        return lx.linear_solve(operator, (basis * values) @ basis.T @ c, Direct()).value

    moving = values != 0
    exact = -(basis * moving * growth) @ basis.T @ c
    np.testing.assert_allclose(jax.jacfwd(solve)(0.0), exact, atol=2e-6)


def test_an_inconsistent_system_is_reported():
    operator = lx.MatrixLinearOperator(jnp.diag(jnp.array([1.0, 0.0])), lx.symmetric_tag)
    solution = lx.linear_solve(operator, jnp.ones(2), Direct(), throw=False)
    assert solution.result == lx.RESULTS.singular
    with pytest.raises(ValueError, match="must be symmetric"):
        lx.linear_solve(lx.MatrixLinearOperator(jnp.eye(2)), jnp.ones(2), Direct())


@pytest.mark.thorough
def test_sensitivities_are_those_of_minres():
    tissue, p0 = random_tissue(N, 2), shape_factors(N, 3.6, 0.05)

    def perimeters(p0, solver):
        adjoint = vx.ImplicitDifferentiation(linear_solver=solver)
        return FIXED_TOPOLOGY(tissue, ShapeFactorEnergy(p0), adjoint=adjoint).tissue.perimeters

    jacobian = eqx.filter_jit(lambda solver: jax.jacfwd(lambda p: perimeters(p, solver))(p0))
    expected = jacobian(vx.MINRES())
    result = jacobian(Direct())
    np.testing.assert_allclose(result, expected, atol=1e-6 * np.abs(expected).max())
    gradient = eqx.filter_jit(jax.grad(lambda p: perimeters(p, Direct()).sum()))
    np.testing.assert_allclose(gradient(p0), expected.sum(axis=0), atol=1e-6)


@pytest.mark.thorough
def test_gauss_newton_without_a_jacobian():
    start = FIXED_TOPOLOGY(random_tissue(N, 2), ShapeFactorEnergy(3.6)).tissue
    truth = ShapeFactorEnergy(shape_factors(N, 3.6, 0.05))
    target = FIXED_TOPOLOGY(start, truth).tissue
    problem = vx.InverseProblem(
        start,
        ShapeFactorEnergy(jnp.full(N, 3.6)),
        vx.costs.VertexDistance(target),
        response=FIXED_TOPOLOGY,
        adjoint=vx.ImplicitDifferentiation(),
    )
    products = lx.Normal(lx.CG(rtol=1e-3, atol=1e-12))
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10, linear_solver=products)
    fit = vx.fit(problem, solver, 7, truth=truth, progress=False)
    assert fit.history.relative_error[-1] < 1e-8
