"""A step of Newton's method within bounds, for quadratic models of all kinds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertax.solvers import _bounded_step
from vertax.solvers._bounded_step import bounded_step

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


def step(g, matrix, bounds, start=None, **given):
    hessian = lambda v: (matrix @ v.reshape(-1)).reshape(v.shape)
    zero = jnp.zeros_like(g)
    system = bounded_step(
        hessian,
        g,
        jnp.linalg.norm(g, axis=-1) / bounds,
        bounds,
        start=(zero, zero) if start is None else start,
        resumes=jnp.array(start is not None),
        helped=jnp.array(False),
        max_products=200,
        options={},
        **({"forcing": jnp.array(1e-3)} | given),
    )
    return system, hessian(system.p)


def judged(g, system, product, bounds):
    far = jnp.max(jnp.linalg.norm(system.p, axis=-1) / bounds)
    wrong = jnp.max(jnp.abs(system.hp - product)) / jnp.max(jnp.abs(product))
    return jnp.vdot(g, system.p), far, wrong


@pytest.mark.parametrize("concave", [0, 0.25, 0.75])
def test_steps_go_downhill_and_stay_within_their_bounds(concave):
    def one(key):
        g, matrix, bounds = model(key, concave)
        return judged(g, *step(g, matrix, bounds), bounds)

    downhill, far, wrong = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 2000))
    assert np.all(downhill < 0)  # and all are numbers
    assert np.all(far <= 2 * (1 + 1e-9))
    np.testing.assert_allclose(wrong, 0, atol=1e-9)


def test_a_step_goes_on_within_smaller_bounds():
    def one(key):
        g, matrix, bounds = model(key)
        before, product = step(g, matrix, bounds)
        smaller = bounds.at[0].multiply(0.01)
        after, product = step(g, matrix, smaller, (before.p, product))
        afresh, _ = step(g, matrix, smaller)
        return *judged(g, after, product, smaller), after.k, afresh.k

    *seen, after, afresh = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), 500))
    downhill, far, wrong = seen
    assert np.all(downhill < 0)
    assert np.all(far <= 2 * (1 + 1e-9))
    np.testing.assert_allclose(wrong, 0, atol=1e-9)
    assert after.mean() < afresh.mean()


@pytest.mark.parametrize("forcing", [1e-2, 1e-6])
def test_within_wide_bounds_it_is_the_step_of_newton(forcing):
    g, matrix, _ = model(jax.random.key(2))
    matrix = matrix @ matrix
    matrix = matrix / jnp.linalg.norm(matrix, 2) + jnp.eye(2 * N)
    system, _ = step(g, matrix, jnp.full(N, 1e9), forcing=jnp.array(forcing))
    exact = -jnp.linalg.solve(matrix, g.reshape(-1)).reshape(g.shape)
    assert jnp.max(jnp.abs(system.p - exact)) < forcing * jnp.max(jnp.abs(exact))


def test_what_is_stiff_is_not_torn(monkeypatch):
    """A rigid body that wants to go far, and one row of it that may not."""
    monkeypatch.setattr(_bounded_step, "_ROUNDS", 0)
    link = 1e3 * (2 * jnp.eye(N) - jnp.roll(jnp.eye(N), 1, 0) - jnp.roll(jnp.eye(N), -1, 0))
    matrix = jnp.kron(link + 1e-3 * jnp.eye(N), jnp.eye(2))
    g, bounds = -3e-3 * jnp.ones((N, 2)), jnp.full(N, 0.5).at[3].set(0.05)
    system, product = step(g, matrix, bounds)
    downhill, far, wrong = judged(g, system, product, bounds)
    assert downhill + 0.5 * jnp.vdot(system.p, product) < 0  # the model gains energy
    assert 1 < far <= 2 * (1 + 1e-9)
    np.testing.assert_allclose(wrong, 0, atol=1e-9)
