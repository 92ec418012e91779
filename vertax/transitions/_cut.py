"""Intersections of the sides of a cell with a straight line through its centroid."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.arcs import arc_points
from vertax._base.indexing import take
from vertax._base.plane import cross
from vertax.mesh import Tissue

# Least distance of the ends of a new edge from the corners, as a fraction of the side.
_MARGIN = 0.05
# Straight pieces per arc in the computation of the long axis of a cell.
_PIECES = 8
# Bisection steps for the intersection of an arc with the line: to select an intersection, and to refine it.
_COARSE, _FINE = 20, 64


class Cut(NamedTuple):
    """The two intersections of a line with a cell."""

    out: Int[Array, ""]
    """The half-edge at which the line leaves the cell."""
    into: Int[Array, ""]
    """The half-edge at which the line enters the cell."""
    fractions: Float[Array, "2"]
    """Positions of the intersections on `out` and `into`, as fractions (0 to 1) of their length."""
    possible: Bool[Array, ""]
    """Whether the intersections exist; otherwise the other fields are undefined."""


def find_cut(
    tissue: Tissue, mask: Bool[Array, " halfedges"], axis: Float[Array, "2"] | None
) -> Cut:
    """Intersect a cell with the line through its centroid and perpendicular to an axis.

    **Arguments:**

    - `tissue`: the tissue.
    - `mask`: which half-edges have the cell on their left.
    - `axis`: the axis; None for the long axis of the cell.
    """
    sides = tissue.sides
    centre, long = _centre_and_axis(sides, mask)
    if tissue.arcs is not None:
        cell = take(tissue.topology.cell, jnp.argmax(mask))
        centre = tissue.centroids.at[cell].get(mode="fill", fill_value=0)
    axis = long if axis is None else axis.astype(sides.dtype)
    axis = axis / jnp.sqrt(jnp.sum(axis**2))
    along = jnp.stack([-axis[1], axis[0]])  # direction of the line
    pieces = _monotone_pieces(sides, centre, axis)
    before, after = pieces.before, pieces.after
    leaves = mask[:, None] & (before < 0) & (after >= 0)
    enters = mask[:, None] & (before >= 0) & (after < 0)
    crosses = leaves | enters
    fraction = before / jnp.where(crosses, before - after, 1)
    low, high = pieces.low, pieces.high
    if tissue.arcs is None:
        points = sides[:, None, :2] + fraction[..., None] * sides[:, None, 2:4]
    else:
        low, high = _bisect(sides, centre, axis, low, high, _COARSE)
        fraction = 0.5 * (low + high)
        points = _points_on_arcs(sides, fraction)
    at = jnp.sum(along * (points - centre), axis=-1).ravel()
    # The first exit after the centroid, and the last entry before that exit.
    leaves, enters = leaves.ravel(), enters.ravel()
    out = jnp.argmin(jnp.where(leaves & (at > 0), at, jnp.inf))
    into = jnp.argmax(jnp.where(enters & (at < at[out]), at, -jnp.inf))
    possible = leaves[out] & enters[into] & (at[out] > 0) & (at[into] < at[out])

    chosen = jnp.stack([out, into])
    half_edges = (chosen // fraction.shape[1]).astype(tissue.topology.twin.dtype)
    fractions = take(fraction.ravel(), chosen)
    if tissue.arcs is not None:
        ends = (take(x.ravel(), chosen)[:, None] for x in (low, high))
        fractions = _refine(take(sides, half_edges), centre, axis, *ends)
    fractions = jnp.clip(fractions, _MARGIN, 1 - _MARGIN)
    # Two cuts of the same side must be apart and create a cell with two sides, possible on the outline only.
    m = tissue.topology
    outer = m.exterior & take(m.on_outline, take(m.edge, half_edges[0]))
    apart = outer & (jnp.abs(fractions[0] - fractions[1]) > _MARGIN)
    apart |= half_edges[0] != half_edges[1]
    return Cut(half_edges[0], half_edges[1], fractions, possible & apart)


def points_at(sides: Float[Array, "n parts"], fractions: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """A point on each side at a given fraction of its length."""
    if sides.shape[-1] == 4:
        return sides[:, :2] + fractions[:, None] * sides[:, 2:4]
    return _points_on_arcs(sides, fractions[:, None])[:, 0]


class _Pieces(NamedTuple):
    """Pieces of sides on which the distance from a line is monotone."""

    low: Float[Array, "sides pieces"]
    """Start of each piece, as a fraction of the length of its side."""
    high: Float[Array, "sides pieces"]
    """End of each piece, as a fraction of the length of its side."""
    before: Float[Array, "sides pieces"]
    """Signed distance from the line at the start."""
    after: Float[Array, "sides pieces"]
    """Signed distance from the line at the end."""


# Relative to the middle of its chord, an arc of angle α has the points, for s in [-1, 1],
#     b sin(α s) / sin α + r (cos(α s) - cos α) / sin α,
# where b is half the chord and r is b rotated clockwise by 90°. The component along an axis has its extrema
# at tan(α s) = (axis · b) / (axis · r): two values of α s that differ by π.
def _monotone_pieces(
    sides: Float[Array, "sides parts"], centre: Float[Array, "2"], axis: Float[Array, "2"]
) -> _Pieces:
    first, chord = sides[:, :2] - centre, sides[:, 2:4]
    distance = lambda x: -jnp.sum(axis * x, axis=-1)
    start, end = distance(first)[:, None], distance(first + chord)[:, None]
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
    middle = distance(_points_on_arcs(sides, inner) - centre)
    # (An extremum beyond the end of the arc gives a piece of length 0.)
    middle = jnp.where(inner <= 0, start, jnp.where(inner >= 1, end, middle))
    values = jnp.concatenate([start, middle, end], axis=-1)
    return _Pieces(marks[:, :-1], marks[:, 1:], values[:, :-1], values[:, 1:])


def _points_on_arcs(
    sides: Float[Array, "n parts"], fractions: Float[Array, "n k"]
) -> Float[Array, "n k 2"]:
    """Points on each side at given fractions of its length."""
    of_side = lambda side, x: arc_points(side[None, :2], side[None, 2:4], side[4:], x)[0]
    return jax.vmap(of_side)(sides, fractions)


def _bisect(
    sides: Float[Array, "n parts"],
    centre: Float[Array, "2"],
    axis: Float[Array, "2"],
    low: Float[Array, "n k"],
    high: Float[Array, "n k"],
    num_steps: int,
) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """Intervals of the intersections with the line perpendicular to the axis, by bisection."""
    distance = lambda x: jnp.sum(axis * (_points_on_arcs(sides, x) - centre), axis=-1)
    positive = distance(high) <= 0

    def halve(_: Array, ends: tuple) -> tuple:
        low, high = ends
        middle = 0.5 * (low + high)
        early = (distance(middle) > 0) == positive
        return jnp.where(early, middle, low), jnp.where(early, high, middle)

    return jax.lax.fori_loop(0, num_steps, halve, (low, high))


def _refine(
    sides: Float[Array, "2 parts"],
    centre: Float[Array, "2"],
    axis: Float[Array, "2"],
    low: Float[Array, "2 1"],
    high: Float[Array, "2 1"],
) -> Float[Array, "2"]:
    """Fractions of the length at which two sides intersect the line."""
    low, high = _bisect(sides, centre, axis, low, high, _FINE)
    # Bisection is not differentiable; a Newton step has the derivative of the intersection.
    root = jax.lax.stop_gradient(0.5 * (low + high))
    distance = lambda x: jnp.sum(axis * (_points_on_arcs(sides, x) - centre), axis=-1)
    value, slope = jax.jvp(distance, (root,), (jnp.ones_like(root),))
    slope = jax.lax.stop_gradient(slope)
    return (root - value / jnp.where(slope == 0, 1, slope))[:, 0]


def _centre_and_axis(
    sides: Float[Array, "halfedges parts"], mask: Bool[Array, " halfedges"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """The centroid of a cell and its long axis; arcs are replaced by polygons."""
    # Relative to a corner, because digits are lost far from the origin.
    reference = sides[jnp.argmax(mask), :2]
    p = sides[:, :2] - reference
    q = p + sides[:, 2:4]
    if sides.shape[-1] > 4:
        fractions = jnp.arange(_PIECES + 1, dtype=sides.dtype) / _PIECES
        points = arc_points(p, sides[:, 2:4], sides[:, 4], fractions)
        p, q = points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2)
        mask = jnp.repeat(mask, _PIECES)
    swept = jnp.where(mask, cross(p, q), 0)
    area = jnp.sum(swept) / 2
    area = jnp.where(area == 0, 1, area)
    centre = jnp.sum((p + q) * swept[:, None], axis=0) / (6 * area)
    p, q = p - centre, q - centre
    swept = jnp.where(mask, cross(p, q), 0)
    # Second moments of the triangles (0, p, q) from the midpoints of their sides, up to a factor.
    points = jnp.stack([p, q, p + q])
    moment = lambda a, b: jnp.sum(swept * jnp.sum(points[..., a] * points[..., b], axis=0))
    xx, xy, yy = moment(0, 0), moment(0, 1), moment(1, 1)
    # (The long axis of an isotropic cell is undefined; this gives a finite derivative.)
    isotropic = (xy == 0) & (xx == yy)
    angle = 0.5 * jnp.arctan2(2 * xy, jnp.where(isotropic, 1, xx - yy))
    return reference + centre, jnp.stack([jnp.cos(angle), jnp.sin(angle)])
