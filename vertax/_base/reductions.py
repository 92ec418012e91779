"""Reductions that XLA compiles to one kernel on a CPU.

XLA recognises `max` and `any` of many numbers and splits them into a tree of three kernels. A reduction by a
function that it does not recognise is one kernel, and as fast.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def any_of(x: Bool[Array, "*shape"]) -> Bool[Array, ""]:
    """Whether any is true."""
    return jax.lax.reduce(x.reshape(-1), np.bool_(False), lambda a, b: jnp.where(b, b, a), (0,))


def max_of(x: Float[Array, "*shape"]) -> Float[Array, ""]:
    """The largest of some numbers that are not negative; NaN is ignored."""
    return jax.lax.reduce(
        x.reshape(-1), np.zeros((), x.dtype), lambda a, b: jnp.where(b > a, b, a), (0,)
    )
