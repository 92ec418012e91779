r"""Barriers: sums of energies of rows of a few numbers, with one Hessian block for each row.

Each row of a barrier of straight edges is an energy $\varphi(s_1, s_2)$ of two scalars, which are functions
of the four numbers $z$ of the row (two vectors). With $g_i = \nabla_z s_i$ and $G_i = \nabla^2_z s_i$,

$$\nabla_z \varphi = \sum_i \varphi_i\, g_i, \qquad
\nabla^2_z \varphi = \sum_{ij} \varphi_{ij}\, g_i g_j^T + \sum_i \varphi_i\, G_i.$$

Automatic differentiation through the same expressions compiles to several times as many kernels.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.half_edges import source
from vertax._base.indexing import take
from vertax._base.sums import total
from vertax.mesh import Tissue, Topology

FLOOR = 1e-4
"""What stands beside the argument of the logarithm: the barrier is finite."""


class Profile(NamedTuple):
    """The barrier $-(1 - x)^2 \\ln x$ below 1, with its first and second derivative."""

    value: Float[Array, "*shape"]
    first: Float[Array, "*shape"]
    second: Float[Array, "*shape"]


def profile(x: Float[Array, "*shape"]) -> Profile:
    """The barrier and its derivatives; 0 from 1 on. Its height at 0 is finite, see `FLOOR`."""
    inside = x < 1
    x = jnp.where(inside, x, 1)
    gap, inverse = 1 - x, 1 / (x + FLOOR)
    log = math.log1p(FLOOR) - jnp.log(x + FLOOR)
    first = -2 * gap * log - gap**2 * inverse
    second = 2 * log + 4 * gap * inverse + (gap * inverse) ** 2
    zero = lambda f: jnp.where(inside, f, 0)
    return Profile(zero(gap**2 * log), zero(first), zero(second))


class Expansion(NamedTuple):
    """Energies of rows, with their first and second derivatives."""

    energy: Float[Array, " rows"]
    slope: Float[Array, "numbers rows"]
    block: Float[Array, "numbers numbers rows"]


def outer(a: Float[Array, "i rows"], b: Float[Array, "j rows"]) -> Float[Array, "i j rows"]:
    """The outer product of each row."""
    return a[:, None] * b[None]


def composed(
    value: Float[Array, " rows"],
    first: tuple[Array, Array],
    second: tuple[Array, Array, Array],
    gradients: tuple[Array, Array],
    hessians: tuple[Array, Array],
) -> Expansion:
    """The expansion of an energy of two scalars, see the top of this file."""
    (f1, f2), (f11, f12, f22) = first, second
    (g1, g2), (h1, h2) = gradients, hessians
    cross = outer(g1, g2)
    block = f11 * outer(g1, g1) + f12 * (cross + jnp.swapaxes(cross, 0, 1)) + f22 * outer(g2, g2)
    return Expansion(value, f1 * g1 + f2 * g2, block + f1 * h1 + f2 * h2)


def differentiated(
    energies: Callable[[Float[Array, "numbers rows"]], Float[Array, " rows"]],
    vectors: Float[Array, "numbers rows"],
) -> Expansion:
    """The expansion of energies of rows, each a function of the numbers of its row.

    By forward differentiation twice: that compiles to fewer kernels than reverse differentiation.
    """
    n, rows = vectors.shape
    directions = jnp.broadcast_to(jnp.eye(n, dtype=vectors.dtype)[:, :, None], (n, n, rows))

    def with_slopes(f: Callable, z: Array) -> tuple:
        return jax.vmap(lambda d: jax.jvp(f, (z,), (d,)), out_axes=(None, 0))(directions)

    first = lambda z: with_slopes(energies, z)
    (energy, slope), (_, block) = with_slopes(first, vectors)
    return Expansion(energy, slope, block)


class GatherPlan(eqx.Module):
    """Where the positions of rows are, in one topology."""

    vertices: Int[Array, "points rows"]
    images: Int[Array, "points rows 2"]
    """In which image of a periodic box."""

    @classmethod
    def of(cls, topology: Topology, half_edges: Int[Array, "points rows"]) -> GatherPlan:
        """At the sources of half-edges, in the frames of the cells on their left."""
        return cls(source(half_edges), take(topology.frame, half_edges))

    @classmethod
    def empty(cls, topology: Topology, shape: tuple[int, int]) -> GatherPlan:
        """A placeholder."""
        index = topology.twin.dtype
        return cls(jnp.zeros(shape, index), jnp.zeros((*shape, 2), topology.frame.dtype))

    def positions(self, tissue: Tissue) -> Float[Array, "points rows 2"]:
        """The positions of those vertices."""
        return take(tissue.vertices, self.vertices) + tissue.boundary.translation(self.images)


class AbstractBarrier(eqx.Module):
    """A sum of energies of rows of numbers, which are linear in the positions of some points (or sides)."""

    @abc.abstractmethod
    def expansion(self, vectors: Float[Array, "numbers rows"]) -> Expansion:
        """The energies of rows and their derivatives."""

    @abc.abstractmethod
    def vectors(self, positions: Float[Array, "points rows parts"]) -> Float[Array, "numbers rows"]:
        """The numbers of each row: two vectors, or the shape of two arcs."""

    @abc.abstractmethod
    def forces(self, slopes: Float[Array, "numbers rows"]) -> Float[Array, "points rows parts"]:
        """The transpose of `vectors`."""


@jax.custom_jvp
def barrier_energy(
    barrier: AbstractBarrier, positions: Float[Array, "points rows parts"]
) -> Float[Array, ""]:
    """The energy of a barrier; derivatives by `barrier` are zero."""
    energies = barrier.expansion(barrier.vectors(positions)).energy
    return jnp.dot(energies, jnp.ones_like(energies))


@barrier_energy.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return barrier_energy(*primals), jnp.sum(_gradient(*primals) * tangents[1])


@jax.custom_jvp
def _gradient(
    barrier: AbstractBarrier, positions: Float[Array, "points rows parts"]
) -> Float[Array, "points rows parts"]:
    return barrier.forces(barrier.expansion(barrier.vectors(positions)).slope)


@_gradient.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    barrier, positions = primals
    block = barrier.expansion(barrier.vectors(positions)).block
    # (A sum over an axis of four takes ten times as long.)
    change = total(block[:, j] * row for j, row in enumerate(barrier.vectors(tangents[1])))
    return _gradient(*primals), barrier.forces(change)
