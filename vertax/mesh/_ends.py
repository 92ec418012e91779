"""What edges see of the vertices at their ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.linear import linear_pair
from vertax._base.sums import total
from vertax.mesh._topology import Topology, source, take


def at_ends(topology: Topology, values: Float[Array, "vertices 2"]) -> Float[Array, "2 2 edges"]:
    """The x, and the y, of a vector of each vertex, at the first and at the second end of each edge."""
    m = topology
    ends = source(jnp.stack([m.half_edge, take(m.twin, m.half_edge)]))
    # Where the three half-edges of each vertex find what comes back to them.
    slots = jnp.where(m.forward, m.edge, m.edge + m.n_edges).reshape(-1, 3).T
    return _at_ends(values, ends, slots)


def _looked_up(
    values: Float[Array, "vertices 2"], ends: Int[Array, "2 edges"], slots: Int[Array, "3 vertices"]
) -> Float[Array, "2 2 edges"]:
    return jnp.stack([take(values[:, axis], ends) for axis in (0, 1)])


def _summed(
    parts: Float[Array, "2 2 edges"], ends: Int[Array, "2 edges"], slots: Int[Array, "3 vertices"]
) -> Float[Array, "vertices 2"]:
    """What all edges have at a vertex, in all."""
    # (XLA would work out the parts anew at each look.)
    parts = jax.lax.optimization_barrier(parts.reshape(2, -1))
    return jnp.stack([total(take(part, slot) for slot in slots) for part in parts], axis=-1)


_at_ends = linear_pair("at_ends", _looked_up, _summed)
