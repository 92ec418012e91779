"""Gather vectors of vertices at the ends of edges, with a transpose that is a gather too."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.custom_transpose import linear_with_transpose
from vertax._base.half_edges import source
from vertax._base.indexing import take
from vertax._base.sums import total
from vertax.mesh._topology import Topology


class EdgeEnds(NamedTuple):
    """The vertices at the ends of each edge, and the edges at each vertex."""

    vertices: Int[Array, "2 edges"]
    """The first and the second vertex of each edge."""
    slots: Int[Array, "3 vertices"]
    """The three edge ends at each vertex: edge number e for a first end, e + n_edges for a second end."""

    @classmethod
    def of(cls, topology: Topology) -> EdgeEnds:
        """The ends of all edges of a topology."""
        m = topology
        vertices = source(jnp.stack([m.half_edge, take(m.twin, m.half_edge)]))
        slots = jnp.where(m.forward, m.edge, m.edge + m.n_edges).reshape(-1, 3).T
        return cls(vertices, slots)

    def gather(self, values: Float[Array, "vertices 2"]) -> tuple[Float[Array, " edges"], ...]:
        """x and y at the first end of each edge, then x and y at the second end."""
        return _gather((values,), *self)

    def scatter_add(self, *parts: Float[Array, " edges"]) -> Float[Array, "vertices 2"]:
        """The transpose of `gather`: for each vertex, the sum over its edge ends."""
        return _sum_at_vertices(parts, *self)[0]


def gather_at_ends(
    topology: Topology, values: Float[Array, "vertices 2"]
) -> tuple[Float[Array, " edges"], ...]:
    """x and y at the first end of each edge, then x and y at the second end."""
    return EdgeEnds.of(topology).gather(values)


def _gather_at_ends(
    values: tuple[Float[Array, "vertices 2"]],
    vertices: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, " edges"], ...]:
    gathered = [take(values[0][:, axis], vertices) for axis in (0, 1)]
    return tuple(component[end] for end in (0, 1) for component in gathered)


def _sum_at_vertices(
    parts: tuple[Float[Array, " edges"], ...],
    vertices: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, "vertices 2"]]:
    x, y, to_x, to_y = parts
    both = [jnp.concatenate(pair) for pair in ((x, to_x), (y, to_y))]
    # (Without the barrier XLA would recompute the parts for each gather.)
    both = jax.lax.optimization_barrier(both)
    return (jnp.stack([total(take(part, slot) for slot in slots) for part in both], axis=-1),)


_gather = linear_with_transpose("gather_at_ends", _gather_at_ends, _sum_at_vertices)
