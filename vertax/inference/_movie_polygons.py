"""The polygons of a frame in a table of tracked cells, and cells that change their numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from vertax.inference._movie import Repair, shortest
from vertax.initialise._faces import Names
from vertax.initialise._nearby_corners import areas_and_centroids, with_images
from vertax.initialise._polygons import corner_images

# The place of another cell, in cell sizes: so far is a cell from it, and from its place before.
_CLOSE = 0.5


class Polygons(NamedTuple):
    """The cells of one frame."""

    frame: int
    """The number of the frame in the movie, from 0."""
    names: Names
    cells: Int[np.ndarray, " cells"]
    """Their numbers in the table."""
    first: Int[np.ndarray, " cells"]
    """The first row of each cell in the table of the frame."""
    places: Float[np.ndarray, "corners 2"]
    corners: list[Int[np.ndarray, " _"]]
    images: list[Int[np.ndarray, "_ 2"]]
    areas: Float[np.ndarray, " cells"]
    """Negative for clockwise cells."""
    centroids: Float[np.ndarray, "cells 2"]

    @property
    def size(self) -> float:
        """Root of the mean area."""
        return float(np.sqrt(np.mean(np.abs(self.areas))))


def polygons_of(
    frame: int,
    label: int,
    cell: Int[np.ndarray, " rows"],
    places: Float[np.ndarray, "rows 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> tuple[Polygons, list[int]]:
    """The polygons of a frame with a label, and the numbers of cells of which a copy was left out."""
    runs = np.split(np.arange(len(cell)), np.flatnonzero(np.diff(cell)) + 1)
    corners: dict[int, np.ndarray] = {}
    copies = []
    for run in runs:
        number = int(cell[run[0]])
        first, other = np.split(run, 2) if len(run) % 2 == 0 else (run, run[:0])
        if number in corners:
            first, other = corners[number], run
        if len(other) > 2 and {*map(tuple, places[first])} == {*map(tuple, places[other])}:
            corners[number] = first
            copies.append(number)
        elif number in corners:
            raise ValueError(
                f"Argument `table` must have each cell once per frame, but cell {number} appears twice in "
                f"frame {label}. Give the other one another number, or put its corners together."
            )
        else:
            corners[number] = run
    cells, rows = np.array([*corners]), [*corners.values()]
    first, places = np.array([each[0] for each in rows]), places[np.concatenate(rows)]
    rows = np.split(np.arange(len(places)), np.cumsum([len(each) for each in rows])[:-1])
    names = Names(
        f"Frame {label} of argument `table`",
        lambda k: f"the point ({places[k, 0]:.4g}, {places[k, 1]:.4g})",
        lambda k: f"cell {cells[k]}",
    )
    images = corner_images(None, rows, places, lattice, names)
    sizes = areas_and_centroids(places, rows, images, lattice)
    return Polygons(frame, names, cells, first, places, rows, images, *sizes), copies


def check_given(
    polygons: Polygons,
    given: dict[str, Float[np.ndarray, " cells"]],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> None:
    """Raise an error for corners that do not have the given areas and centroids, by a quarter of a cell."""
    areas = np.abs(polygons.areas)
    facts = {}
    if "area" in given:
        wrong = np.abs(areas - given["area"]) > 0.25 * areas
        facts["area"] = wrong, areas, given["area"]
    if {"centroid_x", "centroid_y"} <= set(given):
        centroid = np.stack([given["centroid_x"], given["centroid_y"]], axis=1)
        away = np.linalg.norm(shortest(polygons.centroids - centroid, lattice), axis=1)
        facts["centroid"] = away > 0.25 * np.sqrt(areas), polygons.centroids, centroid
    for what, (wrong, measured, other) in facts.items():
        if wrong.any():
            k = int(np.argmax(wrong))
            text = lambda value: ", ".join(f"{x:.4g}" for x in np.atleast_1d(value))
            raise ValueError(
                f"{polygons.names.subject} must have the corners of its cells, but those of "
                f"{polygons.names.cell(k)} have the {what} {text(measured[k])}, and the table has "
                f"{text(other[k])}. Correct the corners or their units, or leave out the columns."
            )


class Numbering:
    """Numbers of cells in a movie, where those of the table change from frame to frame."""

    def __init__(self, lattice: Float[np.ndarray, "2 2"] | None, largest_jump: float):
        self.lattice, self.largest_jump = lattice, largest_jump
        self.number_of: dict[int, int] = {}
        """Number in the movie by number in the table."""
        self.before: dict[int, np.ndarray] = {}
        """Centroids of the last frame by number in the movie."""

    def next_frame(self, polygons: Polygons) -> tuple[Int[np.ndarray, " cells"], list[Repair]]:
        """Numbers of the cells of the next frame in the movie.

        Where cells jump farther than they may, each cell takes the number of the closest cell of the last
        frame, if this is certain for all that moved: within half a cell size, twice as close as the next one,
        and closest the other way round too. New cells take new numbers.
        """
        given: list[int] = polygons.cells.tolist()
        numbers = [self.number_of.get(cell, cell) for cell in given]
        follows = self._certain(polygons, numbers)
        taken = set(follows.values())
        top = max([0, *self.number_of.values(), *numbers, *self.before])
        for k in range(len(numbers)):
            if k in follows:
                numbers[k] = follows[k]
            elif numbers[k] in taken:
                top += 1
                numbers[k] = top
            taken.add(numbers[k])
        self.number_of |= dict(zip(given, numbers, strict=True))
        self.before = dict(zip(numbers, polygons.centroids, strict=True))
        changed = tuple(numbers[k] for k in sorted(follows) if numbers[k] != given[k])
        return np.array(numbers), [Repair("renumbered", polygons.frame, changed)] if follows else []

    def _certain(self, polygons: Polygons, numbers: list[int]) -> dict[int, int]:
        """The number of the last frame for each cell that has one for certain; none without jumps."""
        same = [k for k, number in enumerate(numbers) if number in self.before]
        if not same:
            return {}
        size, now = polygons.size, polygons.centroids
        before = np.array([self.before[numbers[k]] for k in same])
        away = shortest(now[same] - before, self.lattice)
        distance = np.linalg.norm(away, axis=1)
        drift = np.linalg.norm(away - np.median(away, axis=0), axis=1)
        if distance.max() <= self.largest_jump * size or drift.max() <= _CLOSE * size:
            return {}
        given, places = np.array([*self.before]), np.array([*self.before.values()])
        nearest, far = _nearest(now, places, self.lattice, size)
        back, _ = _nearest(places, now, self.lattice, size)
        mutual = back[nearest] == np.arange(len(now))
        certain = np.flatnonzero(mutual & (far[:, 0] < _CLOSE * np.minimum(size, far[:, 1])))
        if not np.isin(np.array(same)[distance > _CLOSE * size], certain).all():
            return {}
        return {int(k): int(given[nearest[k]]) for k in certain}


def _nearest(
    places: Float[np.ndarray, "n 2"],
    origins: Float[np.ndarray, "m 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
    size: float,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """The nearest of other points to each, and the distances of the nearest two."""
    source = np.arange(len(origins))
    if lattice is not None:
        places = places - np.floor(places @ np.linalg.inv(lattice)) @ lattice
        origins, source, _ = with_images(origins, lattice, 2 * size)
    distance, index = map(np.asarray, KDTree(origins).query(places, k=2))
    return source[index[:, 0]], distance
