"""Values and derivatives of minimum and maximum."""

import jax
import jax.numpy as jnp
import numpy as np

from vertax._base.minimum_maximum import maximum, minimum


def test_values_and_derivatives():
    x = jnp.array([-1.0, 0.5, 2.0])
    np.testing.assert_array_equal(minimum(maximum(x, 0), 1), [0, 0.5, 1])
    assert jax.grad(lambda x: jnp.sum(minimum(x, 1)))(x).tolist() == [1, 1, 0]
    assert jax.grad(lambda x: jnp.sum(maximum(x, 0)))(x).tolist() == [0, 1, 1]
    assert jax.grad(lambda x: jnp.sum(minimum(x, x**2)))(x).tolist() == [1, 1, 1]
    assert jnp.isnan(minimum(maximum(jnp.nan * x, 0), 1)).all()
