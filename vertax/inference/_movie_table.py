"""Movies from tables of tracked polygons."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from vertax._base.checks import as_float64, check_number
from vertax.inference._movie import Movie
from vertax.initialise._faces import Names
from vertax.initialise._nearby_corners import build_within, share_corners, size_of_cells
from vertax.initialise._polygons import checked_lattice, corner_images, tissue_from_corners
from vertax.io._read_table import column, whole_numbers
from vertax.mesh import Tissue


def movie_from_table(
    table: Any,
    *,
    box: ArrayLike | None = None,
    tolerance: float | None = None,
    largest_jump: float = 1.0,
) -> Movie:
    """A movie from a table of the corners of tracked cells.

    ```python
    movie = vx.inference.movie_from_table(vx.io.read_table("tracked.csv"))
    movie.events
    ```

    Cells that touch must have the same coordinates at common corners within `tolerance`, in a periodic box up
    to a lattice vector. Include points along curved sides on the outline: such a side becomes an arc that
    keeps the area of its cell. A frame may lack cells: a hole between cells becomes the missing cell that was
    last seen closest to it, if there is one, so that its neighbours keep their places. Frames may be missing
    altogether.

    **Arguments:**

    - `table`: a mapping or a data frame with a row for each corner of each cell in each frame: `frame`, an
        integer, ascending; `cell`, its number, from 0; `x` and `y`, the corner; corners of a cell follow one
        another in order. Optional: `time` of the frame, by default its number; `type` of the cell, an
        integer.
    - `box`: of a periodic tissue, as in [`from_polygons`][vertax.initialise.from_polygons].
    - `tolerance`: as of [`from_polygons`][vertax.initialise.from_polygons], by default 10⁻⁶ of the root mean
        cell area of each frame. Increase it for rounded coordinates and simplified outlines.
    - `largest_jump`: as in [`Movie`][vertax.inference.Movie].

    **Returns:** a [`Movie`][vertax.inference.Movie].

    **Raises:**

    - `ValueError`, naming frame and cell, for columns that are missing, frames out of order, a cell that
        appears twice in a frame or has two types, polygons that overlap, and as
        [`Movie`][vertax.inference.Movie] and [`from_polygons`][vertax.initialise.from_polygons].
    """
    if tolerance is not None:
        check_number("tolerance", tolerance, at_least=0)
    frame, cell = (whole_numbers(table, name, "table") for name in ("frame", "cell"))
    places = np.stack([as_float64("table", column(table, name, "table")) for name in "xy"], axis=1)
    if (np.diff(frame) < 0).any():
        row = int(np.flatnonzero(np.diff(frame) < 0)[0]) + 1
        raise ValueError(
            f"Column `frame` of argument `table` must ascend, but frame {frame[row]} follows frame "
            f"{frame[row - 1]} in row {row}. Sort the rows by frame."
        )
    names = set(table) if hasattr(table, "__iter__") else set()
    times = as_float64("table", column(table, "time", "table")) if "time" in names else frame
    tissues, numbers, moments, filled = [], [], [], []
    last_seen: dict[int, np.ndarray] = {}
    for number in np.unique(frame):
        rows = np.flatnonzero(frame == number)
        if np.ptp(times[rows]) > 0:
            raise ValueError(
                f"Argument `table` must have one time per frame, but frame {number} has several."
            )
        tissue, cells, added = _one_frame(
            int(number), cell[rows], places[rows], box, tolerance, last_seen
        )
        filled.append(added)
        tissues.append(tissue)
        numbers.append(cells)
        moments.append(float(times[rows[0]]))
    types = _types(cell, whole_numbers(table, "type", "table")) if "type" in names else None
    return Movie(
        tissues, moments, cells=numbers, types=types, filled=filled, largest_jump=largest_jump
    )


def _one_frame(
    number: int,
    cell: Int[np.ndarray, " rows"],
    places: Float[np.ndarray, "rows 2"],
    box: ArrayLike | None,
    tolerance: float | None,
    last_seen: dict[int, np.ndarray],
) -> tuple[Tissue, Int[np.ndarray, " cells"], list[int]]:
    """The tissue of a frame, the numbers of its cells, and those of cells that fill holes."""
    starts = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    numbers = cell[starts]
    unique, counts = np.unique(numbers, return_counts=True)
    if (counts > 1).any():
        raise ValueError(
            f"Argument `table` must have each cell once per frame, but cell {unique[counts > 1][0]} appears "
            f"twice in frame {number}. Give the other one another number, or put its corners together."
        )
    lattice = None if box is None else checked_lattice(box)
    corners = np.split(np.arange(len(places)), starts[1:])
    names = Names(
        f"Frame {number} of argument `table`",
        lambda k: f"the point ({places[k, 0]:.4g}, {places[k, 1]:.4g})",
        lambda k: f"cell {numbers[k]}",
    )
    images = corner_images(None, corners, places, lattice, names)
    size = size_of_cells(places, corners, images, lattice)

    def build(within: float) -> tuple[Tissue, list[int]]:
        shared = share_corners(places, corners, images, lattice, within)
        cells, added = shared.cells, []
        if box is None:
            for hole in _holes([cell.tolist() for cell in cells], shared.points):
                middle = shared.points[hole].mean(axis=0)
                lost = {
                    c: np.linalg.norm(p - middle) for c, p in last_seen.items() if c not in numbers
                }
                lost = {c: away for c, away in lost.items() if c not in added}
                if lost:
                    added.append(min(lost, key=lambda c: lost[c]))
                    cells.append(np.array(hole))
        every = [*numbers, *added]
        named = Names(
            names.subject, lambda k: names.point(int(shared.first[k])), lambda k: f"cell {every[k]}"
        )
        images_of = None if box is None else shared.images
        result = tissue_from_corners(shared.points, cells, named, box=box, images=images_of)
        return result.tissue, added

    tissue, added = build_within(
        build, 1e-6 * size if tolerance is None else tolerance, size, names.subject
    )
    numbers = np.append(numbers, np.array(added, int))
    last_seen.update(zip(numbers.tolist(), np.asarray(tissue.centroids), strict=True))
    return tissue, numbers, added


def _holes(corners: list[list[int]], points: Float[np.ndarray, "points 2"]) -> list[list[int]]:
    """Polygons that are surrounded by cells, as corner numbers."""
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
        if len(loop) > 2 and x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0:
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
