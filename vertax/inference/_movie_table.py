"""Movies from tables of tracked polygons."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from vertax._base.checks import as_float64, as_lattice, check_number
from vertax.inference._movie import Movie, Repair
from vertax.inference._movie_polygons import Numbering, Polygons, check_given, polygons_of
from vertax.initialise import PolygonTissue
from vertax.initialise._nearby_corners import build_within, share_corners
from vertax.initialise._polygons import tissue_from_corners
from vertax.io import read_table
from vertax.io._read_table import column, whole_numbers

# Smallest area of a hole that a cell fills, in mean areas, and largest error of rounding, in cell sizes.
_LEAST_HOLE, _LARGEST_ROUNDING = 0.05, 0.05
_GIVEN = ("area", "centroid_x", "centroid_y")


def movie_from_table(
    table: Any,
    *,
    box: ArrayLike | None = None,
    tolerance: float | None = None,
    largest_jump: float = 1.0,
) -> Movie:
    """A movie from a table of the corners of tracked cells, or from files of other programs.

    ```python
    movie = vx.inference.movie_from_table("tracked.csv")
    movie.events, movie.repairs
    ```

    Cells that touch must have the same coordinates at common corners within `tolerance`, in a periodic box up
    to a lattice vector; corners in the middle of a neighbour's side are inserted there, and repeated ones are
    left out. Include points along curved sides on the outline: such a side becomes an arc that keeps the area
    of its cell. A frame may lack cells: a hole between cells becomes the missing cell that was last seen
    closest to it, if there is one, so that its neighbours keep their places. Frames may be missing
    altogether.

    Cells that jump farther than `largest_jump` are renumbered if each cell that moved has, for certain, the
    place of a cell of the frame before. All that was mended is in `movie.repairs`.

    **Arguments:**

    - `table`: a mapping or a data frame with a row for each corner of each cell in each frame: `frame`, an
        integer, ascending; `cell`, its number, from 0; `x` and `y`, the corner; corners of a cell follow one
        another in order. Optional: `time` of the frame, by default its number; `type` of the cell, an
        integer; `area`, `centroid_x` and `centroid_y` of the cell, which are compared with those of its
        corners. Or the path of files that [`read_table`][vertax.io.read_table] reads.
    - `box`: of a periodic tissue, as in [`from_polygons`][vertax.initialise.from_polygons].
    - `tolerance`: as of [`from_polygons`][vertax.initialise.from_polygons], by default 10⁻⁶ of the root mean
        cell area of each frame, or, if cells do not touch within that, twice the distance of decimal numbers
        as precise as the coordinates. Increase it for simplified outlines.
    - `largest_jump`: as in [`Movie`][vertax.inference.Movie].

    **Returns:** a [`Movie`][vertax.inference.Movie].

    **Raises:**

    - `ValueError`, naming frame and cell, for columns that are missing, frames out of order, a cell that
        appears twice in a frame or has two types, other areas or centroids than those given (by a quarter of
        a cell), polygons that overlap, and as [`Movie`][vertax.inference.Movie],
        [`from_polygons`][vertax.initialise.from_polygons] and [`read_table`][vertax.io.read_table].
    """
    if tolerance is not None:
        check_number("tolerance", tolerance, at_least=0)
    if isinstance(table, str | os.PathLike):
        table = read_table(table)
    frame, cell = (whole_numbers(table, name, "table") for name in ("frame", "cell"))
    places = np.stack([as_float64("table", column(table, name, "table")) for name in "xy"], axis=1)
    if (np.diff(frame) < 0).any():
        row = int(np.flatnonzero(np.diff(frame) < 0)[0]) + 1
        raise ValueError(
            f"Column `frame` of argument `table` must ascend, but frame {frame[row]} follows frame "
            f"{frame[row - 1]} in row {row}. Sort the rows by frame."
        )
    names = set(table) if hasattr(table, "__iter__") else set()
    read = lambda name: as_float64("table", column(table, name, "table"))
    times = read("time") if "time" in names else frame
    given = {name: read(name) for name in _GIVEN if name in names}
    lattice = None if box is None else as_lattice(box)
    tissues, numbers, moments, filled, repairs, nodes = [], [], [], [], [], []
    last_seen: dict[int, np.ndarray] = {}
    numbering = Numbering(lattice, largest_jump)
    in_movie = cell.copy()
    for label in np.unique(frame):
        rows = np.flatnonzero(frame == label)
        if np.ptp(times[rows]) > 0:
            raise ValueError(
                f"Argument `table` must have one time per frame, but frame {label} has several."
            )
        polygons, copies = polygons_of(len(tissues), int(label), cell[rows], places[rows], lattice)
        check_given(polygons, {k: x[rows[polygons.first]] for k, x in given.items()}, lattice)
        cells, renumbered = numbering.next_frame(polygons)
        of_cell = dict(zip(polygons.cells.tolist(), cells.tolist(), strict=True))
        in_movie[rows] = [of_cell[each] for each in cell[rows].tolist()]
        result, added, mended = _one_frame(polygons, cells, box, lattice, tolerance, last_seen)
        mended["listed twice"] = [of_cell[each] for each in copies]
        repairs += renumbered
        repairs += [
            Repair(kind, len(tissues), tuple(each)) for kind, each in mended.items() if each
        ]
        filled.append(added)
        tissues.append(result.tissue)
        sides = np.bincount(result.side_edges, minlength=result.tissue.n_edges)
        nodes.append(np.where(result.tissue.topology.on_outline, sides - 1, 0))
        numbers.append(np.append(cells, np.array(added, int)))
        moments.append(float(times[rows[0]]))
    types = _types(in_movie, whole_numbers(table, "type", "table")) if "type" in names else None
    return Movie(
        tissues,
        moments,
        cells=numbers,
        types=types,
        filled=filled,
        repairs=repairs,
        outline_nodes=nodes if box is None else None,
        largest_jump=largest_jump,
    )


def _one_frame(
    polygons: Polygons,
    numbers: Int[np.ndarray, " cells"],
    box: ArrayLike | None,
    lattice: Float[np.ndarray, "2 2"] | None,
    tolerance: float | None,
    last_seen: dict[int, np.ndarray],
) -> tuple[PolygonTissue, list[int], dict[str, list[int]]]:
    """The tissue of a frame, the numbers of cells that fill holes, and those of cells that were mended."""
    names, size, places = polygons.names, polygons.size, polygons.places

    def build(within: float):
        shared = share_corners(places, polygons.corners, polygons.images, lattice, within)
        cells, added = shared.cells.copy(), []
        if box is None:
            for hole in _holes([cell.tolist() for cell in cells], shared.points, size):
                middle = shared.points[hole].mean(axis=0)
                lost = {
                    c: np.linalg.norm(p - middle) for c, p in last_seen.items() if c not in numbers
                }
                lost = {c: away for c, away in lost.items() if c not in added}
                if lost:
                    added.append(min(lost, key=lambda c: lost[c]))
                    cells.append(np.array(hole))
        n = len(numbers)
        named = names._replace(
            point=lambda k: names.point(int(shared.first[k])),
            cell=lambda k: names.cell(k) if k < n else f"cell {added[k - n]}",
        )
        images = None if box is None else shared.images
        result = tissue_from_corners(shared.points, cells, named, box=box, images=images)
        return result, added, shared

    built = None
    least = 1e-6 * size if tolerance is None else tolerance
    rounding = 2 * _rounding(places)
    if tolerance is None and least < rounding < _LARGEST_ROUNDING * size:
        # Corners of one point that were rounded separately differ.
        for within in (least, rounding):
            with suppress(ValueError):
                built = built or build(within)
    result, added, shared = built or build_within(build, least, size, names.subject)
    places = np.asarray(result.tissue.centroids)
    last_seen.update(zip([*numbers.tolist(), *added], places, strict=True))
    given = np.array([len(cell) for cell in polygons.corners])
    sides = np.split(shared.side, np.cumsum(given)[:-1])
    repeated = np.array([int((side < 0).sum()) for side in sides])
    now = np.array([len(cell) for cell in shared.cells])
    mended = {
        "clockwise": polygons.areas < 0,
        "repeated corner": repeated > 0,
        "inserted corner": now > given - repeated,
    }
    return result, added, {kind: numbers[cells].tolist() for kind, cells in mended.items()}


def _rounding(places: Float[np.ndarray, "corners 2"]) -> float:
    """Distance of decimal numbers as precise as the coordinates; 0 for all digits of a float64."""
    values = np.abs(places)
    largest = float(values.max())
    # (Small numbers may have more digits after the point.)
    values = values[values > 0.1 * largest]
    for digits in range(1, 10):
        step = 10.0 ** (np.floor(np.log10(largest)) + 1 - digits) if largest else 0.0
        if step and np.all(np.abs(values / step - np.rint(values / step)) < 1e-5):
            return float(step)
    single = places.astype(np.float32)
    return float(np.spacing(np.abs(single).max())) if np.array_equal(places, single) else 0.0


def _holes(
    corners: list[list[int]], points: Float[np.ndarray, "points 2"], size: float
) -> list[list[int]]:
    """Polygons that are surrounded by cells and not much smaller, as corner numbers."""
    sides = set()
    for polygon in corners:
        x, y = points[polygon].T
        order = polygon if x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0 else polygon[::-1]
        sides |= set(zip(order, order[1:] + order[:1], strict=True))
    # Sides without a partner, reversed, lead around holes counter-clockwise and around the outline clockwise.
    border = {b: a for a, b in sides if (b, a) not in sides}
    holes = []
    while border:
        loop = [next(iter(border))]
        while border.get(loop[-1], loop[0]) != loop[0]:
            loop.append(border.pop(loop[-1]))
        border.pop(loop[-1], None)
        x, y = points[loop].T
        area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
        if len(loop) > 2 and area > _LEAST_HOLE * size**2:
            holes.append(loop)
    return holes


def _types(cell: Int[np.ndarray, " rows"], kind: Int[np.ndarray, " rows"]) -> dict[int, int]:
    pairs = np.unique(np.stack([cell, kind], axis=1), axis=0)
    twice = pairs[1:][np.diff(pairs[:, 0]) == 0]
    if len(twice):
        raise ValueError(
            f"Argument `table` must have one type per cell, but cell {twice[0, 0]} has several. Correct the "
            "column `type`."
        )
    return dict(pairs.tolist())
