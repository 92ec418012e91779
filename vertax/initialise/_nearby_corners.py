"""Corners of cells that touch only within a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from vertax._base.plane import cross
from vertax.initialise._pieces import components

_Result = TypeVar("_Result")
_STEPS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
# The largest tolerance that is tried, in cell sizes.
_LARGEST = 0.1


class SharedCorners(NamedTuple):
    """Points and cells in which cells that touch share their corners."""

    points: Float[np.ndarray, "points 2"]
    cells: list[Int[np.ndarray, " _"]]
    images: list[Int[np.ndarray, "_ 2"]]
    """Lattice image of each corner, as in `from_polygons`."""
    first: Int[np.ndarray, " points"]
    """The first of the given points that each point replaces."""
    side: Int[np.ndarray, " given_sides"]
    """The side that each given side became, or the first part of it; -1 for sides without length."""


def share_corners(
    position: Float[np.ndarray, "points 2"],
    cells: Sequence[Int[np.ndarray, " _"]],
    images: Sequence[Int[np.ndarray, "_ 2"]],
    lattice: Float[np.ndarray, "2 2"] | None,
    tolerance: float,
) -> SharedCorners:
    """Merge points within a tolerance, and give each side the corners of other cells that are on it.

    `cells` and `images` are those of `from_polygons`; without a box all images are 0.
    """
    merged = _merged(position, lattice, tolerance)
    first = np.unique(merged, return_index=True)[1]
    points = position[first]
    image, number = np.concatenate(images), np.concatenate(cells)
    if lattice is not None:
        shift = np.rint((position - points[merged]) @ np.linalg.inv(lattice)).astype(int)
        image = image + shift[number]
    owner = np.repeat(np.arange(len(cells)), [len(cell) for cell in cells])
    corners = np.column_stack([owner, merged[number], image])
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    last = np.append(begin[1:], len(owner)) - 1
    following = np.arange(1, len(owner) + 1)
    following[last] = begin
    kept = np.any(corners != corners[following], axis=1)
    corners = corners[kept]
    side, inserted = _corners_on_sides(points, corners, lattice, tolerance)
    given = np.cumsum(kept) - 1
    given = np.where(kept, given + np.searchsorted(side, given), -1)
    corners = np.insert(corners, side + 1, inserted, axis=0)
    splits = np.searchsorted(corners[:, 0], np.arange(1, len(cells)))
    return SharedCorners(
        points,
        np.split(corners[:, 1], splits),
        np.split(corners[:, 2:], splits),
        first,
        given,
    )


def build_within(
    build: Callable[[float], _Result], tolerance: float, size: float, subject: str
) -> _Result:
    """The result for a tolerance; if it fails, the error names the smallest one that does not.

    **Arguments:**

    - `build`: builds a tissue with a given tolerance, or raises a `ValueError`.
    - `size`: root mean area of the cells.
    - `subject`: names the input in the message.
    """
    try:
        return build(tolerance)
    except ValueError as error:
        first = int(np.floor(np.log10(size))) - 6 if size > 0 else 0
        series = [float(f"{k}e{power}") for power in range(first, first + 7) for k in (1, 2, 5)]
        for larger in series:
            if not tolerance < larger <= _LARGEST * size:
                continue
            try:
                build(larger)
            except ValueError:
                continue
            raise ValueError(
                f"{subject} must share corners where cells touch, but do so only within {larger:g}. Pass "
                f"`tolerance={larger:g}`, or correct the corners."
            ) from error
        raise


def size_of_cells(
    position: Float[np.ndarray, "points 2"],
    cells: Sequence[Int[np.ndarray, " _"]],
    images: Sequence[Int[np.ndarray, "_ 2"]],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> float:
    """Square root of the mean area of the polygons."""
    areas = areas_and_centroids(position, cells, images, lattice)[0]
    return float(np.sqrt(np.mean(np.abs(areas))))


def areas_and_centroids(
    position: Float[np.ndarray, "points 2"],
    cells: Sequence[Int[np.ndarray, " _"]],
    images: Sequence[Int[np.ndarray, "_ 2"]],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, "cells 2"]]:
    """Area of each polygon, negative if it is clockwise, and its centroid."""
    areas, centroids = [], []
    for cell, image in zip(cells, images, strict=True):
        ring = position[cell] if lattice is None else position[cell] + image @ lattice
        rest = ring - ring[0]
        following = np.roll(rest, -1, axis=0)
        swept = cross(rest, following)
        areas.append(0.5 * swept.sum())
        middle = swept @ (rest + following) / (6 * areas[-1]) if areas[-1] else rest.mean(axis=0)
        centroids.append(ring[0] + middle)
    return np.array(areas), np.array(centroids)


def _merged(
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
    tolerance: float,
) -> Int[np.ndarray, " points"]:
    """One number for all points at one place, in order of appearance."""
    place, source = position, np.arange(len(position))
    if lattice is not None:
        place, source, _ = with_images(position, lattice, 2 * tolerance)
    links = source[KDTree(place).query_pairs(tolerance, output_type="ndarray")]
    group = components(len(position), links[:, 0], links[:, 1])[1]
    first = np.unique(group, return_index=True)[1]
    return np.argsort(np.argsort(first))[group]


def with_images(
    position: Float[np.ndarray, "points 2"], lattice: Float[np.ndarray, "2 2"], rim: float
) -> tuple[Float[np.ndarray, "places 2"], Int[np.ndarray, " places"], Int[np.ndarray, "places 2"]]:
    """All images of points in the box with a rim around it, of at most one box.

    **Returns:** the places, the point and its lattice image of each.
    """
    inverse = np.linalg.inv(lattice)
    fraction = position @ inverse
    image = _STEPS[:, None] - np.floor(fraction).astype(int)
    shifted = fraction + image
    width = rim * np.linalg.norm(inverse, axis=0)
    near = np.all((shifted > -width) & (shifted < 1 + width), axis=2)
    source = np.nonzero(near)[1]
    return position[source] + image[near] @ lattice, source, image[near]


def _corners_on_sides(
    points: Float[np.ndarray, "points 2"],
    corners: Int[np.ndarray, "sides 4"],
    lattice: Float[np.ndarray, "2 2"] | None,
    tolerance: float,
) -> tuple[Int[np.ndarray, " inserted"], Int[np.ndarray, "inserted 4"]]:
    """The sides on which corners of other cells are, in order, and those corners.

    A corner is its cell, its point and the lattice image of that.
    """
    owner, image = corners[:, 0], corners[:, 2:]
    start = points[corners[:, 1]]
    start = start if lattice is None else start + image @ lattice
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    end = np.roll(start, -1, axis=0)
    end[np.append(begin[1:], len(owner)) - 1] = start[begin]
    middle, half = 0.5 * (start + end), 0.5 * np.linalg.norm(end - start, axis=1)
    home = np.zeros((len(owner), 2), int)
    if lattice is None:
        place, source, shift = points, np.arange(len(points)), np.zeros((len(points), 2), int)
    else:
        home = np.floor(middle @ np.linalg.inv(lattice)).astype(int)
        middle = middle - home @ lattice
        place, source, shift = with_images(points, lattice, half.max() + tolerance)
    near = KDTree(place).query_ball_point(middle, half + tolerance)
    side = np.repeat(np.arange(len(owner)), [len(each) for each in near])
    candidate = np.concatenate([np.asarray(each, int) for each in near])
    along = (end - start)[side]
    away = place[candidate] - middle[side]
    length = 2 * half[side]
    # Along the side from its middle, and across it, in units of length.
    parallel = np.sum(away * along, axis=1) / length
    across = cross(along, away) / length
    on_side = (np.abs(across) <= tolerance) & (np.abs(parallel) < half[side])
    side, candidate, parallel = side[on_side], candidate[on_side], parallel[on_side]
    inserted = np.column_stack([owner[side], source[candidate], shift[candidate] + home[side]])
    present = set(map(tuple, corners.tolist()))
    missing = np.array([tuple(row) not in present for row in inserted.tolist()], bool)
    order = np.lexsort((parallel[missing], side[missing]))
    return side[missing][order], inserted[missing][order]
