"""Reductions that XLA compiles to one kernel on a CPU.

XLA splits `max` and `any` of a large array into three kernels. A reduction by a function that XLA does not
recognise is one kernel, and as fast.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


def any_of(x: Bool[Array, "*shape"]) -> Bool[Array, ""]:
    """Whether any entry is true."""
    return jax.lax.reduce(x.reshape(-1), np.bool_(False), lambda a, b: jnp.where(b, b, a), (0,))


def max_of(x: Float[Array, "*shape"]) -> Float[Array, ""]:
    """The maximum of numbers ≥ 0; NaN is ignored."""
    return jax.lax.reduce(
        x.reshape(-1), np.zeros((), x.dtype), lambda a, b: jnp.where(b > a, b, a), (0,)
    )


def count_true(x: Bool[Array, "*shape"]) -> Float[Array, ""]:
    """The number of entries that are true."""
    ones = jnp.ones(x.size, jnp.float32)
    return jnp.dot(x.reshape(-1).astype(jnp.float32), ones)


def indices_of_true(
    mask: Bool[Array, " n"], size: int
) -> tuple[Int[Array, " size"], Bool[Array, " size"]]:
    """The first `size` indices at which a mask is true, in ascending order, and which of these are valid.

    (`jax.numpy.nonzero` computes a prefix sum: twenty kernels.)
    """
    values, indices = jax.lax.top_k(mask.astype(jnp.float32), min(size, mask.size))
    pad = max(0, size - mask.size)
    return jnp.pad(indices, (0, pad)), jnp.pad(values > 0, (0, pad))
