"""Barriers: sums of functions of four numbers each, such as of a corner and a side that are near."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.sums import total

FLOOR = 1e-4
"""What stands beside the argument of their logarithm: they are finite, and high enough."""

# Energies of places, one a row, and something else that they depend on.
_Energies = Callable[[Any, Float[Array, "some 4"]], Float[Array, " some"]]


# Forces are worked out in forward mode, and second derivatives as a block for each row: once, and not again
# in every product with the Hessian.
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def local_sum(energies: _Energies, args: Any, places: Float[Array, "some 4"]) -> Float[Array, ""]:
    """The energy of all places; derivatives by `args` are not known."""
    return jnp.sum(energies(args, places))


@local_sum.defjvp
def _(energies: _Energies, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return local_sum(energies, *primals), jnp.sum(_slopes(energies, *primals) * tangents[-1].T)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _slopes(energies: _Energies, args: Any, places: Float[Array, "some 4"]) -> Array:
    return _along_each(lambda x: energies(args, x), places)


@_slopes.defjvp
def _(energies: _Energies, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    blocks = local_blocks(energies, *primals)
    change = total(block * row for block, row in zip(blocks, tangents[-1].T, strict=True))
    return _slopes(energies, *primals), change


def local_blocks(
    energies: _Energies, args: Any, places: Float[Array, "some 4"]
) -> Float[Array, "4 4 some"]:
    """The second derivatives by the four numbers of each row."""
    return _along_each(lambda x: _slopes.fun(energies, args, x), places)


def _along_each(
    function: Callable[[Array], Array], places: Float[Array, "some 4"]
) -> Float[Array, "4 ..."]:
    """How a function of places, row by row, changes with each of their four parts."""
    along = lambda unit: jax.jvp(function, (places,), (jnp.broadcast_to(unit, places.shape),))[1]
    return jax.vmap(along)(jnp.eye(4, dtype=places.dtype))
