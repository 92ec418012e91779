"""1/x, 1/√x and log x with derivatives that reuse the result of the division.

On a CPU, XLA compiles one loop for each division, and the derivatives of JAX divide again.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.custom_jvp
def reciprocal(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 / x."""
    return 1 / x


@reciprocal.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = reciprocal(*primals)
    return y, -y * y * tangents[0]


@jax.custom_jvp
def inverse_square_root(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 / √x."""
    return 1 / jnp.sqrt(x)


@inverse_square_root.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = inverse_square_root(*primals)
    return y, -0.5 * y * y * y * tangents[0]


@jax.custom_jvp
def logarithm(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The natural logarithm."""
    return jnp.log(x)


@logarithm.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return logarithm(*primals), reciprocal(*primals) * tangents[0]
