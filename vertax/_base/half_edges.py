"""Arithmetic of half-edges: `h = 3 v + k` is the k-th half-edge of vertex v, counter-clockwise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

# These functions use `jax.lax` to compile fast: `//`, `%` and `[]` of jax.numpy each expand into a dozen
# operations for negative numbers and bounds.


def source(h: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """The vertex that a half-edge leaves."""
    return jax.lax.div(h, jnp.asarray(3, h.dtype))


def clockwise(h: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """The half-edge one slot clockwise around the same vertex."""
    slot = jax.lax.rem(h, jnp.asarray(3, h.dtype))
    return h + jax.lax.select(slot == 0, jnp.full_like(h, 2), jnp.full_like(h, -1))


def counter_clockwise(h: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """The half-edge one slot counter-clockwise around the same vertex."""
    slot = jax.lax.rem(h, jnp.asarray(3, h.dtype))
    return h + jax.lax.select(slot == 2, jnp.full_like(h, -2), jnp.full_like(h, 1))
