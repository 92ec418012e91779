"""Barriers: sums of functions of four numbers each, such as of a corner and a side that are near."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.reciprocal import logarithm
from vertax._base.sums import total
from vertax.mesh import Tissue
from vertax.mesh._topology import Topology, source, take

FLOOR = 1e-4
"""What stands beside the argument of their logarithm: they are finite, and high enough."""


def barrier(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """-(1 - x)² ln x, up to 1: almost, see `FLOOR`."""
    return (1 - x) ** 2 * (jnp.log1p(FLOOR) - logarithm(x + FLOOR))


class Looks(eqx.Module):
    """Which vertices the numbers of each row come from, in one topology: found once, and looked at often."""

    vertices: Int[Array, "*some"]
    images: Int[Array, "*some 2"]
    """In which image of a periodic box."""

    @classmethod
    def of(cls, topology: Topology, half_edges: Int[Array, "*some"]) -> Looks:
        """At the sources of half-edges, in the frames of the cells on their left."""
        return cls(source(half_edges), take(topology.frame, half_edges))

    def flat(self) -> Looks:
        """One after the other."""
        return Looks(self.vertices.reshape(-1), self.images.reshape(-1, 2))

    def __getitem__(self, which: slice) -> Looks:
        return Looks(self.vertices[which], self.images[which])

    def then(self, other: Looks) -> Looks:
        """Those, and then others."""
        return jax.tree.map(lambda *both: jnp.concatenate(both), self, other)

    def at(self, tissue: Tissue) -> Float[Array, "*some 2"]:
        """Where those vertices are."""
        return take(tissue.vertices, self.vertices) + tissue.boundary.translation(self.images)


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


# (Compiled functions, so that each is traced once.)
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
@functools.partial(jax.jit, static_argnums=0)
def _slopes(energies: _Energies, args: Any, places: Float[Array, "some 4"]) -> Array:
    return along_each(lambda x: energies(args, x), places)


@_slopes.defjvp
def _(energies: _Energies, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    blocks = local_blocks(energies, *primals)
    change = total(block * row for block, row in zip(blocks, tangents[-1].T, strict=True))
    return _slopes(energies, *primals), change


@functools.partial(jax.jit, static_argnums=0)
def local_blocks(
    energies: _Energies, args: Any, places: Float[Array, "some 4"]
) -> Float[Array, "4 4 some"]:
    """The second derivatives by the four numbers of each row."""
    slopes = lambda x: along_each(lambda x: energies(args, x), x)
    return along_each(slopes, places)


def along_each(
    function: Callable[[Array], Array], places: Float[Array, "some 4"]
) -> Float[Array, "4 ..."]:
    """How a function of places, row by row, changes with each of their four parts."""
    along = lambda unit: jax.jvp(function, (places,), (jnp.broadcast_to(unit, places.shape),))[1]
    return jax.vmap(along)(jnp.eye(4, dtype=places.dtype))
