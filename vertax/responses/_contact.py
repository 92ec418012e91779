"""Contact: what keeps the sides of a face from passing through one another."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue
from vertax.mesh._overlaps import Overlaps, overlaps_and_nearest
from vertax.mesh._topology import take

# A face comes to overlap itself where a corner reaches a side that it does not end. A barrier holds it off
# (Li et al. 2020, doi:10.1145/3386569.3392425), with s = (D/d)² for the distance D and a range d:
#
#     -d² (1 - s)² ln s     if s < 1, otherwise 0:   twice differentiable, and infinite at s = 0.
#
# Corners that share a short edge are near each other and not in contact. So for a side next to one of the
# corner's own the range is a share of the distance r to their common end: what counts there is the angle.
SLOPE = 5.0
"""That share over the range in cells: both are the same at a fifth of a cell from the end."""


class Contacts(eqx.Module):
    """The barrier between corners and sides that are near, in one topology.

    **Arguments:**

    - `distance`: the range far from the ends of a side, a length.
    - `slope`: the range over the distance to the end near the ends.
    - `strength`: energy per length squared.
    - `pairs`: half-edges whose source is near another side of their face, and that side; the same twice
        where there are fewer pairs.
    """

    distance: Float[Array, ""]
    slope: Float[Array, ""]
    strength: Float[Array, ""]
    pairs: Int[Array, "contacts 2"]

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of the barrier."""
        corners, following = tissue.corners, tissue.topology.next
        corner, side = self.pairs[:, 0], self.pairs[:, 1]
        start = take(corners, side)
        chord = take(corners, take(following, side)) - start
        adjacent = next_to(corner, side, following)
        near, squared = self.nearness(take(corners, corner), start, chord, adjacent)
        near = jnp.where((near < 1) & (corner != side), near, 1)
        return self.strength * jnp.sum(-squared * (1 - near) ** 2 * jnp.log(near))

    def nearness(
        self,
        point: Float[Array, "n 2"],
        start: Float[Array, "n 2"],
        chord: Float[Array, "n 2"],
        adjacent: Bool[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Squared distance of points from sides over the squared range; the squared range."""
        first = point - start
        squared = jnp.sum(chord**2, axis=-1)
        share = jnp.sum(first * chord, axis=-1) / jnp.where(squared > 0, squared, 1)
        way = first - jnp.clip(share, 0, 1)[:, None] * chord
        to_end = jnp.minimum(jnp.sum(first**2, axis=-1), jnp.sum((first - chord) ** 2, axis=-1))
        range_ = jnp.broadcast_to(self.distance**2, squared.shape)
        short = self.slope**2 * to_end
        range_ = jnp.where(adjacent, range_ * short / (range_ + short), range_)
        return jnp.sum(way**2, axis=-1) / jnp.where(range_ > 0, range_, 1), range_


def next_to(
    corner: Int[Array, " n"], side: Int[Array, " n"], following: Int[Array, " halfedges"]
) -> Bool[Array, " n"]:
    """Whether a side is next to one of the two that meet at a corner."""
    return (take(following, corner) == side) | (take(following, take(following, side)) == corner)


def contacts_of(
    reach: float | Float[Array, ""], options: dict[str, Array], tissue: Tissue
) -> tuple[Contacts, Overlaps]:
    """The contacts of a tissue, and where it overlaps.

    **Arguments:**

    - `reach`: the range in units of the size of a cell.
    - `options`: of a minimiser: typical sizes.
    """
    length, stiffness = options["length_scale"], options["stiffness"]
    slope = jnp.asarray(SLOPE * reach, length.dtype)
    # The barrier must not depend on the parameters of the energy, not even through its strength: that would be
    # one more derivative. So it is a power of 16.
    strength = 16.0 ** jnp.round(jnp.log(stiffness) / jnp.log(16.0)) / slope
    none = jnp.zeros((tissue.n_vertices, 2), tissue.topology.twin.dtype)
    contacts = Contacts(reach * length, slope, strength, none)
    here, following = jnp.arange(tissue.topology.n_half_edges), tissue.topology.next

    def measure(point: Array, start: Array, chord: Array, side: Array) -> Array:
        return contacts.nearness(point, start, chord, next_to(here, side, following))[0]

    overlaps, sides, near = overlaps_and_nearest(tissue, measure)
    # What is as near as this may come into range in the next step.
    which, rank = jnp.nonzero(near < _MARGIN**2, size=len(none), fill_value=0)
    pairs = jnp.stack([which.astype(none.dtype), sides[which, rank]], axis=-1)
    # (What fills up the list is pair 0, which may be one.)
    there = jnp.arange(len(none)) < jnp.sum(near < _MARGIN**2)
    pairs = jnp.where(there[:, None], pairs, none)
    return eqx.tree_at(lambda c: c.pairs, contacts, pairs), overlaps


_MARGIN = 4
