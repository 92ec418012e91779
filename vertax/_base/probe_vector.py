"""A deterministic pseudo-random vector for estimates of traces and norms of operators."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def probe_vector(like: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """cos(n (n + 1/2)) for n = 0, 1, 2, …, in the given shape and dtype.

    For the mean eigenvalue of an operator this is as good as random numbers, and it compiles much faster.
    """
    n = jax.lax.iota(like.dtype, like.size).reshape(like.shape)
    return jnp.cos(n * (n + 0.5))
