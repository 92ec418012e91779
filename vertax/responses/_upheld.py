"""What keeps short edges from turning inside out."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.extremes import greater
from vertax._base.reciprocal import inverse_root, reciprocal
from vertax.mesh import Tissue
from vertax.mesh._sides import dot
from vertax.mesh._topology import Topology, edge_neighbourhood, take
from vertax.responses._local import FLOOR, Looks, barrier
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

    @property
    def any(self) -> Bool[Array, ""]:
        """Whether there are any."""
        return jnp.any(self.edges < len(self.counts))

    @property
    def held(self) -> Bool[Array, " edges"]:
        """Which edges these are."""
        return jnp.zeros(len(self.counts), bool).at[self.edges].set(True, mode="drop")

    def looks(self, topology: Topology) -> Looks:
        """At the ends of each edge, and the far ends of its four neighbours, in one frame."""
        m = topology
        edges = jnp.minimum(self.edges, m.n_edges - 1)
        _, *neighbours = edge_neighbourhood(m, edges)
        leaving = jnp.stack([take(m.half_edge, edges), *neighbours], axis=-1)
        here, there = Looks.of(m, leaving), Looks.of(m, take(m.next, leaving))
        start, end = here.images[:, :1], there.images[:, :1]
        offsets = there.images - here.images
        images = [start, end, start + offsets[:, 1:3], end + offsets[:, 3:]]
        vertices = jnp.concatenate([here.vertices[:, :1], there.vertices], axis=1)
        return Looks(vertices, jnp.concatenate(images, axis=1))

    def places(self, around: Float[Array, "some 6 2"]) -> Float[Array, "some 4"]:
        """Each edge as a vector, and which way it ought to point, from where these are."""
        start, end, a, b, c, d = (around[:, k] for k in range(6))
        axis = edge_axis(end - start, a - start, b - start, c - end, d - end)
        return jnp.concatenate([end - start, axis], axis=-1)

    def heights(self, places: Float[Array, "some 4"]) -> Float[Array, " some"]:
        """The energy of each."""
        heights = turned_height(places[:, :2], places[:, 2:], self.reach, self.force)
        return jnp.where(self.edges < len(self.counts), heights, 0)

    def updated(self, tissue: Tissue, turned: Bool[Array, " edges"]) -> Upheld:
        """With those that were put upright, and without those that have grown."""
        n = tissue.n_edges
        chord = tissue.edge_vectors
        counts = self.counts + turned
        held = self.held & (dot(chord, chord) < (_LONG * self.reach) ** 2)
        held |= turned & (counts >= _OFTEN)
        edges = jnp.nonzero(held, size=len(self.edges), fill_value=n)[0]
        return Upheld(edges.astype(self.edges.dtype), counts, self.reach, self.force)


# An edge is held until it is so long: one step could turn it again from where its barrier ends.
_LONG = 4 * _FADE
# An edge is held once it was put upright so often. (Edges under high tension often turn on their way.)
_OFTEN = 8
# So many edges are held at most, or one of so many.
_FEWEST, _SHARE = 16, 256


def turned_height(
    edge: Float[Array, "some 2"],
    axis: Float[Array, "some 2"],
    reach: Float[Array, ""],
    force: Float[Array, ""],
) -> Float[Array, " some"]:
    """The energy that it takes to turn edges away from the way they ought to point."""
    squared = dot(edge, edge)
    inverse = reciprocal(reach)
    far = squared * (inverse / _FADE) ** 2
    near = jax.lax.stop_gradient(far < 1)
    # (What is said of others does not matter, and must have a derivative.)
    axis = jnp.where(near[:, None], axis, 1)
    per_length = inverse_root(greater(dot(axis, axis), jnp.finfo(axis.dtype).tiny))
    softened = squared + (FLOOR * reach) ** 2
    length = softened * inverse_root(softened)
    upright = (length + dot(edge, axis) * per_length) * (0.5 * inverse)
    upright = jnp.where(near & (upright < 1), upright, 1)
    return force * reach * greater(1 - far, 0) ** 3 * barrier(upright)
