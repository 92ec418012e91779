"""Whether a tissue tiles the plane: where its cells overlap, or nearly do."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh._topology import Topology, take

if TYPE_CHECKING:
    from vertax.mesh._tissue import Tissue

Carry = TypeVar("Carry")


# If every face is a simple polygon (of arcs) that runs counter-clockwise, and the exterior clockwise, then the
# tissue tiles the plane: by their turning numbers the angles of all faces add up to one full turn for each
# vertex, and no vertex has less, so its three faces surround it once. Nothing has to be compared across
# faces.
class Overlaps(eqx.Module):
    """Where the faces of a tissue overlap; under `jax.vmap` one entry for each of the batch.

    A tissue tiles the plane if each of its cells, and the exterior of a free one, is a simple polygon (of
    straight edges or of arcs), and no cell is inside out.
    """

    crossed: Int[Array, "*batch halfedges"]
    """For each half-edge another one, a side of the same face, that it crosses; itself if there is none."""
    cells: Bool[Array, "*batch cells"]
    """Which cells cross themselves or are inside out."""
    exterior: Bool[Array, "*batch"]
    """Whether the outline of a free tissue crosses itself."""

    @property
    def any(self) -> Bool[Array, "*batch"]:
        """Whether anything overlaps."""
        return jnp.any(self.cells, axis=-1) | self.exterior

    @property
    def sides(self) -> Bool[Array, "*batch halfedges"]:
        """Which half-edges cross another side of the face on their left."""
        return self.crossed != jnp.arange(self.crossed.shape[-1])

    def describe(self) -> str:
        """Where the tissue (of a batch: the first one that does) overlaps, in words; empty if nowhere."""
        bad = np.flatnonzero(np.atleast_1d(self.any))
        if not bad.size:
            return ""
        of_first = lambda x: np.asarray(x).reshape(-1, x.shape[-1])[bad[0]]
        cells, crossed = of_first(self.cells), of_first(self.crossed)
        where = [f"cell {cell}" for cell in np.flatnonzero(cells)[:3]]
        if np.ravel(self.exterior)[bad[0]]:
            where.append("the outline")
        if np.sum(cells) > 3:
            where.append(f"{np.sum(cells)} cells in all")
        sides = np.flatnonzero(crossed != np.arange(crossed.size))
        if sides.size:
            ends = sides[0] // 3, crossed[sides[0]] // 3
            where.append(f"where sides that leave the vertices {ends[0]} and {ends[1]} cross")
        return ", ".join(where)


def find_overlaps(tissue: Tissue) -> Overlaps:
    """Compare each side with all others of its face."""
    here = _numbers(tissue.topology)
    crossed = around(tissue.topology, _comparing(tissue), here)
    return _overlaps(tissue, crossed)


def overlaps_and_nearest(
    tissue: Tissue, measure: Callable[[Array, Array, Array, Array], Float[Array, " halfedges"]]
) -> tuple[Overlaps, Int[Array, "halfedges 2"], Float[Array, "halfedges 2"]]:
    """Overlaps; and of each corner the two nearest sides of its face that it does not end.

    **Arguments:**

    - `measure`: how near each corner is to a side, given by its start, its vector and its number.

    **Returns:** the overlaps; the two sides, as half-edges; how near they are.
    """
    m, corners = tissue.topology, tissue.corners
    chords = take(corners, m.next) - corners
    here = _numbers(m)
    compare = _comparing(tissue)

    def both(k: Int[Array, ""], other: Int[Array, " halfedges"], carry: tuple) -> tuple:
        crossed, sides, gaps = carry
        gap = measure(corners, take(corners, other), take(chords, other), other)
        gap = jnp.where(other == here, jnp.inf, gap)
        closest = gap < gaps[0]
        second = ~closest & (gap < gaps[1])
        insert = lambda x, best: (
            jnp.where(closest, x, best[0]),
            jnp.where(closest, best[0], jnp.where(second, x, best[1])),
        )
        return compare(k, other, crossed), insert(other, sides), insert(gap, gaps)

    none = jnp.full(here.size, jnp.inf, corners.dtype)
    crossed, sides, gaps = around(m, both, (here, (here, here), (none, none)))
    return _overlaps(tissue, crossed), jnp.stack(sides, axis=-1), jnp.stack(gaps, axis=-1)


def _comparing(
    tissue: Tissue,
) -> Callable[[Int[Array, ""], Int[Array, " halfedges"], Array], Array]:
    m, corners = tissue.topology, tissue.corners
    chords = take(corners, m.next) - corners

    def compare(k: Int[Array, ""], other: Int[Array, " halfedges"], crossed: Array) -> Array:
        crosses = _segments_cross(corners, chords, take(corners, other), take(chords, other))
        return jnp.where(crosses & (k > 1), other, crossed)

    return compare


def _overlaps(tissue: Tissue, crossed: Int[Array, " halfedges"]) -> Overlaps:
    m = tissue.topology
    crosses = (crossed != _numbers(m)).astype(jnp.int32)
    faces = jax.ops.segment_max(crosses, m.cell, m.n_faces) > 0
    exterior = faces[-1] if m.exterior else jnp.array(False)
    return Overlaps(crossed, faces[: m.n_cells] | ~(tissue.areas > 0), exterior)


def _numbers(topology: Topology) -> Int[Array, " halfedges"]:
    return jnp.arange(topology.n_half_edges, dtype=topology.twin.dtype)


def around(
    topology: Topology,
    body: Callable[[Int[Array, ""], Int[Array, " halfedges"], Carry], Carry],
    start: Carry,
) -> Carry:
    """Walk around all faces at once: `body` sees each half-edge with the one k sides further.

    k goes from 1 to two less than the sides of the largest face; half-edges that are through are paired
    with themselves. So each corner meets all sides of its face that it does not end.
    """
    following = topology.next
    n_sides = jax.ops.segment_sum(jnp.ones_like(topology.cell), topology.cell, topology.n_faces)
    last = take(n_sides, topology.cell) - 2
    here = _numbers(topology)

    def one(k: Int[Array, ""], carry: tuple) -> tuple:
        other, inner = carry
        other = take(following, other)
        return other, body(k, jnp.where(k <= last, other, here), inner)

    _, end = jax.lax.fori_loop(1, jnp.max(last) + 1, one, (here, start))
    return end


def _segments_cross(
    p: Float[Array, "n 2"], u: Float[Array, "n 2"], q: Float[Array, "n 2"], v: Float[Array, "n 2"]
) -> Bool[Array, " n"]:
    """Whether the segments p … p + u and q … q + v have a point in common that ends neither."""
    w = q - p
    apart = (cross(u, w) * cross(u, w + v) >= 0) | (cross(v, w) * cross(v, w - u) >= 0)
    # Rounding may let sides in one line, like those of a row of bricks, look crossed.
    low, high = jnp.minimum(p, p + u), jnp.maximum(p, p + u)
    below, above = jnp.minimum(q, q + v), jnp.maximum(q, q + v)
    return ~apart & jnp.all((low <= above) & (below <= high), axis=-1)


def cross(p: Float[Array, "*n 2"], q: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
