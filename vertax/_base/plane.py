"""Products of vectors in the plane, and the inverse of a 2 × 2 matrix."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped


def cross(p: Shaped[Any, "*n 2"], q: Shaped[Any, "*n 2"]) -> Shaped[Any, "*n"]:
    """Cross product of vectors in the plane, of JAX or NumPy."""
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def dot(p: Float[Array, "*n 2"], q: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Scalar product."""
    return p[..., 0] * q[..., 0] + p[..., 1] * q[..., 1]


def inverse_of(lattice: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """The inverse of a 2 × 2 matrix by its formula, which compiles faster than `jnp.linalg.inv`."""
    (a, b), (c, d) = lattice
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / (a * d - b * c)
