"""Where a straight line through the centroid of a cell cuts its sides."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue
from vertax.mesh._arcs import arc_points
from vertax.mesh._sides import cross
from vertax.mesh._topology import take

# The ends of a new edge keep this share of the side they lie on away from its corners.
_MARGIN = 0.05
# Straight pieces by which an arc counts for the long axis of a cell.
_PIECES = 8
# Halvings of the piece of an arc in which it crosses the line: to choose a crossing, and to find its place.
_COARSE, _FINE = 20, 64


class Cut(NamedTuple):
    """Where a line leaves a cell, and where it came in before."""

    out: Int[Array, ""]
    """The half-edge where it leaves the cell."""
    into: Int[Array, ""]
    """The half-edge where it enters it."""
    shares: Float[Array, "2"]
    """At which share of the length of either that is."""
    possible: Bool[Array, ""]
    """Whether there are such crossings; if not the rest means nothing."""


def find_cut(
    tissue: Tissue, mine: Bool[Array, " halfedges"], axis: Float[Array, "2"] | None
) -> Cut:
    """Where the line across an axis, through the centroid of a cell, cuts the cell.

    **Arguments:**

    - `tissue`: the tissue.
    - `mine`: which half-edges have the cell on their left.
    - `axis`: the axis; None for the long one.
    """
    sides = tissue.sides
    centre, long = _centre_and_axis(sides, mine)
    if tissue.arcs is not None:
        cell = take(tissue.topology.cell, jnp.argmax(mine))
        centre = tissue.centroids.at[cell].get(mode="fill", fill_value=0)
    axis = long if axis is None else axis.astype(sides.dtype)
    axis = axis / jnp.sqrt(jnp.sum(axis**2))
    along = jnp.stack([-axis[1], axis[0]])  # of the cut
    pieces = _monotone_pieces(sides, centre, axis)
    before, after = pieces.before, pieces.after
    leaves = mine[:, None] & (before < 0) & (after >= 0)
    enters = mine[:, None] & (before >= 0) & (after < 0)
    crosses = leaves | enters
    share = before / jnp.where(crosses, before - after, 1)
    low, high = pieces.low, pieces.high
    if tissue.arcs is None:
        points = sides[:, None, :2] + share[..., None] * sides[:, None, 2:4]
    else:
        low, high = _halved(sides, centre, axis, low, high, _COARSE)
        share = 0.5 * (low + high)
        points = _on_arcs(sides, share)
    at = jnp.sum(along * (points - centre), axis=-1).ravel()
    # Where the line leaves the cell after the centroid, and where it last came in before.
    leaves, enters = leaves.ravel(), enters.ravel()
    out = jnp.argmin(jnp.where(leaves & (at > 0), at, jnp.inf))
    into = jnp.argmax(jnp.where(enters & (at < at[out]), at, -jnp.inf))
    possible = leaves[out] & enters[into] & (at[out] > 0) & (at[into] < at[out])

    chosen = jnp.stack([out, into])
    half_edges = (chosen // share.shape[1]).astype(tissue.topology.twin.dtype)
    shares = take(share.ravel(), chosen)
    if tissue.arcs is not None:
        ends = (take(x.ravel(), chosen)[:, None] for x in (low, high))
        shares = _refined(take(sides, half_edges), centre, axis, *ends)
    shares = jnp.clip(shares, _MARGIN, 1 - _MARGIN)
    # Two cuts in one side must lie apart, and cut off a cell of two sides: only the outline has those.
    m = tissue.topology
    outer = m.exterior & take(m.on_outline, take(m.edge, half_edges[0]))
    apart = outer & (jnp.abs(shares[0] - shares[1]) > _MARGIN)
    apart |= half_edges[0] != half_edges[1]
    return Cut(half_edges[0], half_edges[1], shares, possible & apart)


def points_at(sides: Float[Array, "n parts"], shares: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """A point of each side, at a share of its length."""
    if sides.shape[-1] == 4:
        return sides[:, :2] + shares[:, None] * sides[:, 2:4]
    return _on_arcs(sides, shares[:, None])[:, 0]


class _Pieces(NamedTuple):
    """Pieces of sides on which the distance from a line rises or falls throughout."""

    low: Float[Array, "sides pieces"]
    """The share of the length of the side where it begins,"""
    high: Float[Array, "sides pieces"]
    """and where it ends;"""
    before: Float[Array, "sides pieces"]
    """how far it is there from the line."""
    after: Float[Array, "sides pieces"]


# With half the chord b and its right r, an arc of angle α is at s from -1 to 1
#     b sin(α s) / sin α + r (cos(α s) - cos α) / sin α        from the middle of its chord.
# Along an axis that has its extrema at tan(α s) = (axis · b) / (axis · r): two of them, half a turn apart.
def _monotone_pieces(
    sides: Float[Array, "sides parts"], centre: Float[Array, "2"], axis: Float[Array, "2"]
) -> _Pieces:
    first, chord = sides[:, :2] - centre, sides[:, 2:4]
    beside = lambda x: -jnp.sum(axis * x, axis=-1)
    start, end = beside(first)[:, None], beside(first + chord)[:, None]
    zero = jnp.zeros_like(start)
    if sides.shape[-1] == 4:
        return _Pieces(zero, zero + 1, start, end)
    angle = sides[:, 4]
    b = chord[:, 0] * axis[0] + chord[:, 1] * axis[1]
    r = chord[:, 1] * axis[0] - chord[:, 0] * axis[1]
    turn = jnp.arctan2(jnp.where(r < 0, -b, b), jnp.abs(r))
    other = turn - jnp.where(turn < 0, -jnp.pi, jnp.pi)
    extrema = jnp.stack([turn, other], axis=-1) / jnp.where(angle == 0, 1, angle)[:, None]
    inner = jnp.sort(0.5 * (1 + jnp.clip(extrema, -1, 1)), axis=-1)
    marks = jnp.concatenate([zero, inner, zero + 1], axis=-1)
    middle = beside(_on_arcs(sides, inner) - centre)
    # (An extremum beyond the end of the arc makes a piece without length.)
    middle = jnp.where(inner <= 0, start, jnp.where(inner >= 1, end, middle))
    values = jnp.concatenate([start, middle, end], axis=-1)
    return _Pieces(marks[:, :-1], marks[:, 1:], values[:, :-1], values[:, 1:])


def _on_arcs(sides: Float[Array, "n parts"], shares: Float[Array, "n k"]) -> Float[Array, "n k 2"]:
    """Points at some shares of the length of each side."""
    one = lambda side, share: arc_points(side[None, :2], side[None, 2:4], side[4:], share)[0]
    return jax.vmap(one)(sides, shares)


def _halved(
    sides: Float[Array, "n parts"],
    centre: Float[Array, "2"],
    axis: Float[Array, "2"],
    low: Float[Array, "n k"],
    high: Float[Array, "n k"],
    times: int,
) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """The pieces in which sides cross the line across an axis, halved some times."""
    distance = lambda share: jnp.sum(axis * (_on_arcs(sides, share) - centre), axis=-1)
    positive = distance(high) <= 0

    def halve(_: Array, ends: tuple) -> tuple:
        low, high = ends
        middle = 0.5 * (low + high)
        early = (distance(middle) > 0) == positive
        return jnp.where(early, middle, low), jnp.where(early, high, middle)

    return jax.lax.fori_loop(0, times, halve, (low, high))


def _refined(
    sides: Float[Array, "2 parts"],
    centre: Float[Array, "2"],
    axis: Float[Array, "2"],
    low: Float[Array, "2 1"],
    high: Float[Array, "2 1"],
) -> Float[Array, "2"]:
    """At which share of their length two sides cross the line."""
    low, high = _halved(sides, centre, axis, low, high, _FINE)
    # Bisection has no derivative; a step of Newton's method has the right one.
    found = jax.lax.stop_gradient(0.5 * (low + high))
    at = lambda share: jnp.sum(axis * (_on_arcs(sides, share) - centre), axis=-1)
    value, slope = jax.jvp(at, (found,), (jnp.ones_like(found),))
    slope = jax.lax.stop_gradient(slope)
    return (found - value / jnp.where(slope == 0, 1, slope))[:, 0]


def _centre_and_axis(
    sides: Float[Array, "halfedges parts"], mine: Bool[Array, " halfedges"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """The centroid of a cell and its long axis; of arcs, as polygons."""
    # From one of its corners: far from the origin digits would be lost.
    reference = sides[jnp.argmax(mine), :2]
    p = sides[:, :2] - reference
    q = p + sides[:, 2:4]
    if sides.shape[-1] > 4:
        fractions = jnp.arange(_PIECES + 1, dtype=sides.dtype) / _PIECES
        points = arc_points(p, sides[:, 2:4], sides[:, 4], fractions)
        p, q = points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2)
        mine = jnp.repeat(mine, _PIECES)
    swept = jnp.where(mine, cross(p, q), 0)
    area = jnp.sum(swept) / 2
    area = jnp.where(area == 0, 1, area)
    centre = jnp.sum((p + q) * swept[:, None], axis=0) / (6 * area)
    p, q = p - centre, q - centre
    swept = jnp.where(mine, cross(p, q), 0)
    # Of a triangle from the centroid, but for a factor: the three points half-way along its sides.
    points = jnp.stack([p, q, p + q])
    moment = lambda a, b: jnp.sum(swept * jnp.sum(points[..., a] * points[..., b], axis=0))
    xx, xy, yy = moment(0, 0), moment(0, 1), moment(1, 1)
    # (A round cell has no long axis, nor a derivative of it.)
    round_ = (xy == 0) & (xx == yy)
    angle = 0.5 * jnp.arctan2(2 * xy, jnp.where(round_, 1, xx - yy))
    return reference + centre, jnp.stack([jnp.cos(angle), jnp.sin(angle)])
