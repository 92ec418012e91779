"""What keeps short edges from turning inside out."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue
from vertax.mesh._sides import dot
from vertax.mesh._topology import edge_neighbourhood, take
from vertax.responses._local import FLOOR, local_sum
from vertax.transitions._edge_frames import edge_axis

# Where an energy presses the ends of an edge together, the edge opens once it has flipped. Forces can press
# it from all sides: then four cells meet in a point, flipped or not, and the energy is least where the edge
# points a little the wrong way. A barrier holds it, as of contacts, where the share of the edge that points
# the way it ought to is below a range.
REACH = 2e-3
"""That range, in units of the size of a cell."""
# And in units of it the length from which on the barrier is nothing at all.
_FADE = 8.0


class Upheld(eqx.Module):
    """The barrier of those edges that a relaxation had to put upright.

    **Arguments:**

    - `edges`: their numbers, and that of no edge after the last one.
    - `counts`: how often each edge was put upright.
    - `reach`: its range, a length.
    - `force`: about what it resists with at a third of that.
    """

    edges: Int[Array, " some"]
    counts: Int[Array, " edges"]
    reach: Float[Array, ""]
    force: Float[Array, ""]

    @classmethod
    def none(cls, tissue: Tissue, reach: Float[Array, ""], force: Float[Array, ""]) -> Upheld:
        """Of no edge yet."""
        n = tissue.n_edges
        some = min(n, max(_FEWEST, n // _SHARE))
        none = jnp.full(some, n, tissue.topology.edge.dtype)
        return cls(none, jnp.zeros(n, jnp.int32), reach, force)

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of the barrier."""
        m = tissue.topology
        there = self.edges < tissue.n_edges
        edges = jnp.where(there, self.edges, 0)
        half_edges = jnp.concatenate([take(m.half_edge, edges), *edge_neighbourhood(m, edges)[1:]])
        chords = tissue.sides_of(half_edges)[:, 2:4].reshape(5, -1, 2)
        places = jnp.concatenate([chords[0], edge_axis(*chords)], axis=-1)
        return local_sum(_heights, (self, there), places)

    def updated(self, tissue: Tissue, turned: Bool[Array, " edges"]) -> Upheld:
        """With those that were put upright, and without those that have grown."""
        n = tissue.n_edges
        held = jnp.zeros(n, bool).at[self.edges].set(True, mode="drop")
        chord = tissue.edge_vectors
        counts = self.counts + turned
        held &= dot(chord, chord) < (_FADE * self.reach) ** 2
        held |= turned & (counts >= _OFTEN)
        edges = jnp.nonzero(held, size=len(self.edges), fill_value=n)[0]
        there = edges.astype(self.edges.dtype), counts
        return eqx.tree_at(lambda u: (u.edges, u.counts), self, there)


# An edge is held once it was put upright so often. (Edges under high tension often turn on their way.)
_OFTEN = 8
# So many edges are held at most, or one of so many.
_FEWEST, _SHARE = 16, 256


def _heights(
    args: tuple[Upheld, Bool[Array, " some"]], places: Float[Array, "some 4"]
) -> Float[Array, " some"]:
    upheld, there = args
    heights = turned_height(places[:, :2], places[:, 2:], upheld.reach, upheld.force)
    return jnp.where(there, heights, 0)


def turned_height(
    edge: Float[Array, "some 2"],
    axis: Float[Array, "some 2"],
    reach: Float[Array, ""],
    force: Float[Array, ""],
) -> Float[Array, " some"]:
    """The energy that it takes to turn edges away from the way they ought to point."""
    squared = jnp.sum(edge**2, axis=-1)
    near = jax.lax.stop_gradient(squared < (_FADE * reach) ** 2)
    # (What is said of others does not matter, and must have a derivative.)
    axis = jnp.where(near[:, None], axis, 1)
    norm = jnp.sqrt(jnp.maximum(jnp.sum(axis**2, axis=-1), jnp.finfo(axis.dtype).tiny))
    length = jnp.sqrt(squared + (FLOOR * reach) ** 2)
    upright = (length + jnp.sum(edge * axis, axis=-1) / norm) / (2 * reach)
    upright = jnp.where(near & (upright < 1), upright, 1)
    fade = jnp.maximum(1 - squared / (_FADE * reach) ** 2, 0) ** 3
    barrier = -((1 - upright) ** 2) * jnp.log((upright + FLOOR) / (1 + FLOOR))
    return force * reach * fade * barrier
