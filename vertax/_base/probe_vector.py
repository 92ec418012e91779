"""A vector without pattern, to probe an operator with."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def probe_vector(like: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Numbers between -1 and 1 that look random, always the same ones.

    For the mean eigenvalue of an operator they are as good as random numbers, which take longer to compile
    than all of an energy.
    """
    n = jax.lax.iota(like.dtype, like.size).reshape(like.shape)
    return jnp.cos(n * (n + 0.5))
