"""The lesser and the greater of two numbers, where that is differentiated.

JAX asks of the derivative of a minimum which of the two equals it. A compiler that works one of them out
again in another place may round it otherwise; then neither does, and the derivative is lost.
(If the first is not a number, neither is what comes of it.)
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def minimum(a: Float[Array, "..."], b: ArrayLike) -> Float[Array, "..."]:
    """The lesser of two numbers; with the derivative of the second where they are equal."""
    return jnp.where(a >= b, b, a)


def maximum(a: Float[Array, "..."], b: ArrayLike) -> Float[Array, "..."]:
    """The greater of two numbers; with the derivative of the second where they are equal."""
    return jnp.where(a <= b, b, a)
