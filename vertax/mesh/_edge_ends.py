"""What edges see of the vertices at their ends."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.custom_transpose import linear_with_transpose
from vertax._base.sums import total
from vertax.mesh._topology import Topology, source, take


class EdgeEnds(NamedTuple):
    """Which vertices are at the ends of each edge, and which edges are at each vertex."""

    vertices: Int[Array, "2 edges"]
    """The first end of each edge, and the second."""
    slots: Int[Array, "3 vertices"]
    """The three edges of each vertex: as one of the first ends, or after those as one of the second."""

    @classmethod
    def of(cls, topology: Topology) -> EdgeEnds:
        """Those of all edges."""
        m = topology
        vertices = source(jnp.stack([m.half_edge, take(m.twin, m.half_edge)]))
        slots = jnp.where(m.forward, m.edge, m.edge + m.n_edges).reshape(-1, 3).T
        return cls(vertices, slots)

    def gather(self, values: Float[Array, "vertices 2"]) -> tuple[Float[Array, " edges"], ...]:
        """The x and y of a vector of each vertex, at the first end of each edge, and then at the second."""
        return _looked((values,), *self)

    def scatter_add(self, *parts: Float[Array, " edges"]) -> Float[Array, "vertices 2"]:
        """The transpose of that: what all edges have at a vertex, in all."""
        return _summed(parts, *self)[0]


def gather_at_ends(
    topology: Topology, values: Float[Array, "vertices 2"]
) -> tuple[Float[Array, " edges"], ...]:
    """The x and y of a vector of each vertex, at the first end of each edge, and then at the second."""
    return EdgeEnds.of(topology).gather(values)


def _looked_up(
    values: tuple[Float[Array, "vertices 2"]],
    vertices: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, " edges"], ...]:
    looks = [take(values[0][:, axis], vertices) for axis in (0, 1)]
    return tuple(look[end] for end in (0, 1) for look in looks)


def _summed(
    parts: tuple[Float[Array, " edges"], ...],
    vertices: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, "vertices 2"]]:
    x, y, to_x, to_y = parts
    both = [jnp.concatenate(pair) for pair in ((x, to_x), (y, to_y))]
    # (XLA would work out the parts anew at each look.)
    both = jax.lax.optimization_barrier(both)
    return (jnp.stack([total(take(part, slot) for slot in slots) for part in both], axis=-1),)


_looked = linear_with_transpose("gather_at_ends", _looked_up, _summed)
