"""Minima and maxima that are differentiated."""

import jax
import jax.numpy as jnp
import numpy as np

from vertax._base.extremes import greater, lesser


def test_values_and_derivatives():
    x = jnp.array([-1.0, 0.5, 2.0])
    np.testing.assert_array_equal(lesser(greater(x, 0), 1), [0, 0.5, 1])
    assert jax.grad(lambda x: jnp.sum(lesser(x, 1)))(x).tolist() == [1, 1, 0]
    assert jax.grad(lambda x: jnp.sum(greater(x, 0)))(x).tolist() == [0, 1, 1]
    assert jax.grad(lambda x: jnp.sum(lesser(x, x**2)))(x).tolist() == [1, 1, 1]
    assert jnp.isnan(lesser(greater(jnp.nan * x, 0), 1)).all()
