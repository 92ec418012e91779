"""A step of Newton's method within bounds, for quadratic models of all kinds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertax.solvers._conjugate_gradients import DiagonalInverse, TruncatedCG

N = 12


def model(key, concave=0.25):
    """A gradient, a Hessian with a share of negative eigenvalues, and bounds of different sizes."""
    keys = jax.random.split(key, 4)
    basis = jnp.linalg.qr(jax.random.normal(keys[0], (2 * N, 2 * N)))[0]
    values = 10 ** jax.random.uniform(keys[1], (2 * N,), minval=-3, maxval=3)
    values = values * jnp.where(jnp.arange(2 * N) < concave * 2 * N, -0.1, 1)
    matrix = basis @ jnp.diag(values) @ basis.T
    gradient = jax.random.normal(keys[2], (N, 2))
    bounds = 10 ** jax.random.uniform(keys[3], (N,), minval=-3, maxval=0)
    return gradient, 0.5 * (matrix + matrix.T), bounds


def step(g, matrix, bounds, forcing=1e-3, damped=True, **settings):
    hessian = lambda v: (matrix @ v.reshape(-1)).reshape(v.shape)
    proposal = TruncatedCG(**settings)(
        hessian,
        g,
        damped * jnp.linalg.norm(g, axis=-1) / bounds,
        bounds,
        DiagonalInverse(1.0),
        jnp.asarray(forcing),
        max_products=200,
        active=jnp.array(True),
    )
    return proposal, hessian(proposal.step)


def judged(g, proposal, product, bounds):
    far = jnp.max(jnp.linalg.norm(proposal.step, axis=-1) / bounds)
    wrong = jnp.max(jnp.abs(proposal.product - product)) / jnp.max(jnp.abs(product))
    return jnp.vdot(g, proposal.step), far, wrong


@pytest.mark.parametrize(
    "concave", [0.25, *(pytest.param(x, marks=pytest.mark.thorough) for x in (0, 0.75))]
)
def test_steps_descend_within_their_bounds(concave):
    def one(key):
        g, matrix, bounds = model(key, concave)
        return judged(g, *step(g, matrix, bounds), bounds)

    downhill, far, wrong = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 2000))
    assert np.all(downhill < 0)  # and all are numbers
    assert np.all(far <= 2 * (1 + 1e-9))
    np.testing.assert_allclose(wrong, 0, atol=1e-8)


@pytest.mark.parametrize("forcing", [1e-2, 1e-6])
def test_within_wide_bounds_it_is_the_newton_step(forcing):
    g, matrix, _ = model(jax.random.key(2))
    matrix = matrix @ matrix
    matrix = matrix / jnp.linalg.norm(matrix, 2) + jnp.eye(2 * N)
    proposal, _ = step(g, matrix, jnp.full(N, 1e9), forcing)
    exact = -jnp.linalg.solve(matrix, g.reshape(-1)).reshape(g.shape)
    assert jnp.max(jnp.abs(proposal.step - exact)) < forcing * jnp.max(jnp.abs(exact))
