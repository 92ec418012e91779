"""Minimum and maximum with derivatives that do not depend on rounding.

JAX finds the derivative of `jnp.minimum(a, b)` by comparing the result with `a` and `b`. XLA may recompute
one of them with another rounding; then neither is equal and the derivative is 0. The functions below compare
`a` and `b` only. NaN in `a` propagates.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def minimum(a: Float[Array, "..."], b: ArrayLike) -> Float[Array, "..."]:
    """min(a, b); where a = b, the derivative is that of `b`."""
    return jnp.where(a >= b, b, a)


def maximum(a: Float[Array, "..."], b: ArrayLike) -> Float[Array, "..."]:
    """max(a, b); where a = b, the derivative is that of `b`."""
    return jnp.where(a <= b, b, a)
