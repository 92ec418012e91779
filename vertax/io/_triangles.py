"""Triangulation of polygons that are not convex, for programs that draw them wrongly."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def is_convex(polygon: Float[np.ndarray, "corners 2"]) -> bool:
    """Whether no corner of a counter-clockwise polygon is reflex, up to rounding.

    **Arguments:**

    - `polygon`: its corners.

    **Returns:** whether it is convex. A clockwise polygon is not.
    """
    # Of two corners at one place one is left out: the side between them has no direction.
    apart = np.linalg.norm(polygon - np.roll(polygon, 1, axis=0), axis=1)
    corners = polygon[~(apart <= 1e-9 * np.max(np.ptp(polygon, axis=0)))]
    turns = _turn(np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0))
    return bool(np.all(turns >= -_rounding(polygon)))


def triangulate(polygon: Float[np.ndarray, "corners 2"]) -> Int[np.ndarray, "triangles 3"]:
    """Triangles that tile a simple polygon, by clipping of ears (Meisters 1975, doi:10.2307/2319703).

    1. A corner is an ear if it is not reflex, and no reflex corner of the polygon is in the triangle of it
       and its two neighbours.
    2. The triangle of an ear is a part of the polygon; the rest is a polygon with one corner less.

    Every simple polygon has an ear. If rounding errors or crossing sides leave none, the rest becomes a fan.

    **Arguments:**

    - `polygon`: its corners, counter-clockwise. Some may lie at the same place or in one line.

    **Returns:** numbers of the corners of each triangle, counter-clockwise. Corners in one line are those of
    triangles of area 0: without these the outline of the triangles would not be the polygon.
    """
    rest = list(range(len(polygon)))
    tolerance = _rounding(polygon)
    triangles: list[tuple[int, int, int]] = []
    place, misses = 0, 0
    while len(rest) > 3 and misses < len(rest):
        size = len(rest)
        corner = rest[place - 1], rest[place % size], rest[(place + 1) % size]
        if not _is_ear(polygon, rest, corner, tolerance):
            place, misses = (place + 1) % size, misses + 1
            continue
        triangles.append(corner)
        del rest[place % size]
        # The next corner but one: neighbouring ears in turn would make a fan of slivers.
        place, misses = (place + 1) % (size - 1), 0
    triangles += [(rest[0], rest[k], rest[k + 1]) for k in range(1, len(rest) - 1)]
    return np.array(triangles)


def _is_ear(
    polygon: Float[np.ndarray, "corners 2"],
    rest: list[int],
    corner: tuple[int, int, int],
    tolerance: float,
) -> bool:
    """Whether the triangle of a corner and its neighbours is a part of the polygon of the rest."""
    a, b, c = polygon[np.array(corner)]
    turn = _turn(a, b, c)
    if turn < -tolerance:
        return False
    if turn <= tolerance:  # three points in one line: the triangle has no area
        return True
    points = polygon[np.array(rest)]
    reflex = _turn(np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0)) < tolerance
    others = points[reflex]
    inside = (_turn(a, b, others) >= -tolerance) & (_turn(b, c, others) >= -tolerance)
    inside &= _turn(c, a, others) >= -tolerance
    apart = np.all([np.any(others != point, axis=1) for point in (a, b, c)], axis=0)
    return not np.any(inside & apart)


def _turn(
    a: Float[np.ndarray, "*#points 2"],
    b: Float[np.ndarray, "*#points 2"],
    c: Float[np.ndarray, "*#points 2"],
) -> Float[np.ndarray, "..."]:
    """Twice the area of the triangle a, b, c; positive if it is counter-clockwise."""
    first, second = b - a, c - a
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def _rounding(polygon: Float[np.ndarray, "corners 2"]) -> float:
    """Rounding error of the area of a triangle of its corners."""
    extent = float(np.max(np.ptp(polygon, axis=0)))
    return 16 * float(np.finfo(polygon.dtype).eps) * float(np.max(np.abs(polygon))) * extent
