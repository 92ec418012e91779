"""What edges see of the vertices at their ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.linear import linear_pair
from vertax._base.sums import total
from vertax.mesh._topology import Topology, source, take


def at_ends(
    topology: Topology, values: Float[Array, "vertices 2"]
) -> tuple[Float[Array, " edges"], ...]:
    """The x and y of a vector of each vertex, at the first end of each edge, and then at the second."""
    m = topology
    ends = source(jnp.stack([m.half_edge, take(m.twin, m.half_edge)]))
    # Where the three half-edges of each vertex find what comes back to them.
    slots = jnp.where(m.forward, m.edge, m.edge + m.n_edges).reshape(-1, 3).T
    return _at_ends((values,), ends, slots)


def _looked_up(
    values: tuple[Float[Array, "vertices 2"]],
    ends: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, " edges"], ...]:
    looks = [take(values[0][:, axis], ends) for axis in (0, 1)]
    return tuple(look[end] for end in (0, 1) for look in looks)


def _summed(
    parts: tuple[Float[Array, " edges"], ...],
    ends: Int[Array, "2 edges"],
    slots: Int[Array, "3 vertices"],
) -> tuple[Float[Array, "vertices 2"]]:
    """What all edges have at a vertex, in all."""
    x, y, to_x, to_y = parts
    both = [jnp.concatenate(pair) for pair in ((x, to_x), (y, to_y))]
    # (XLA would work out the parts anew at each look.)
    both = jax.lax.optimization_barrier(both)
    return (jnp.stack([total(take(part, slot) for slot in slots) for part in both], axis=-1),)


_at_ends = linear_pair("at_ends", _looked_up, _summed)
