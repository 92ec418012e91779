"""Tissues from the corners of their cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from vertax._base.checks import as_float64, as_lattice, check_concrete, check_number, describe
from vertax._base.plane import cross
from vertax.initialise._faces import FaceMesh, Names, Sides, build_faces
from vertax.initialise._nearby_corners import build_within, share_corners, size_of_cells
from vertax.initialise._overlap_repair import crossed_by, repair_overlaps
from vertax.mesh import Free, Periodic, Tissue, angle_of_area, geometry_of
from vertax.surfaces import HeightMap


class PolygonTissue(eqx.Module):
    """A tissue made from polygons, and how it relates to them.

    Vertices have the order of the given points, and cells that of the given cells: if no point was removed or
    split and no cell left out, their numbers are the same.
    """

    tissue: Tissue
    """The tissue, in the units of the points."""
    cells: Int[np.ndarray, " cells"]
    """Number of each cell among the given ones."""
    points: Int[np.ndarray, " vertices"]
    """Number of the point of each vertex."""
    side_edges: Int[np.ndarray, " sides"]
    """The edge of each given side, one cell after the other: side k of a cell leads from its corner k to its
    next one. -1 for sides of cells that were left out."""
    open_cells: Bool[np.ndarray, " cells"]
    """Open cells: their areas and perimeters are those of a closed outline that is not in the data."""
    closing_edges: Bool[np.ndarray, " edges"]
    """Edges that close an open cell, at least in part."""
    removed_points: Int[np.ndarray, " removed"]
    """Points inside an edge, where two edges meet: they are no vertices."""
    split_points: Int[np.ndarray, " split"]
    """Points where more than three edges meet: they are several vertices."""
    flattened_edges: Bool[np.ndarray, " edges"]
    """Arcs that were made flatter, because cells would have overlapped."""


def from_polygons(
    points: ArrayLike | Sequence[Any],
    cells: Sequence[Any] | Shaped[np.ndarray | Array, "cells corners"],
    *,
    box: ArrayLike | Sequence[Any] | None = None,
    images: Sequence[Any] | None = None,
    tolerance: float | None = None,
    open_cells: ArrayLike | Sequence[Any] | None = None,
    keep_open: bool = True,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> PolygonTissue:
    """Tissue from a table of points and, for each cell, the numbers of its corners in order.

    ```python
    points = [[0, 0], [1, 0], [2, 0], [2, 1], [1, 1], [0, 1]]
    tissue = vx.initialise.from_polygons(points, [[0, 1, 4, 5], [1, 2, 3, 4]]).tissue
    ```

    The corners of a cell may run clockwise or counter-clockwise: the sign of the area of its polygon shows
    which. Cells that touch must share the corner numbers at both ends of each common side. Where they do not,
    `tolerance` merges points, and adds corners to sides on which those of other cells are.

    - Three edges meet: the point is a vertex.
    - Two edges meet: the point is inside an edge, and is removed (`removed_points`). An edge between two
        cells becomes straight, or with `inner_arcs` an arc that keeps the areas of its cells. An edge on the
        outline of a free tissue becomes an arc that keeps the area of its cell, up to an angle of 0.9 π.
    - k > 3 edges meet: the point becomes k - 2 vertices, joined by edges of length 0 (`split_points`). The
        cell of the lowest number there touches the others along them; on the outline, it is one of the
        two cells next to the exterior.

    A tissue that was cut out of a larger one, by the border of an image for instance, has cells at its border
    without a closed outline. Name them by `open_cells`: a straight side from the last to the first corner
    closes each of them (`closing_edges`), or, with `keep_open=False`, they are left out.

    **Arguments:**

    - `points`, shape `(points, 2)`: positions x, y, in units of length. (Where y counts the rows of an image
        downwards, change its sign, or the tissue is mirrored.) Of a curved free tissue, shape `(points, 3)`:
        the tissue is the projection along z, on the smooth surface through the points (see
        [`HeightMap.through`][vertax.surfaces.HeightMap.through]), with straight edges on its outline too.
    - `cells`: for each cell, the numbers of its corners in order, from 0; three at least, without the first
        one again at the end.
    - `box`: of a periodic tissue, width and height, or two lattice vectors as rows, shape `(2, 2)`. Points
        may lie outside the box. Without it the tissue is free.
    - `images`: of a periodic tissue, for each cell, integers of shape `(corners, 2)`: its corner k is at
        `points[cell[k]] + images[k] @ lattice`. By default each side takes the shortest way that closes the
        outline, which is right where at most one side of a cell is longer than half the box.
    - `tolerance`: points closer together than this are one, the first of them; a point closer than this to a
        side of another cell is a corner of that cell too. In units of length; smaller than the sides of the
        cells. By default points are what `cells` says.
    - `open_cells`: numbers of open cells, or a boolean for each cell.
    - `keep_open`: keep open cells, or leave them out with the points that only they have.
    - `inner_arcs`: make every edge an arc, and not only those on the outline of a free tissue.
    - `softening`: passed on to [`Tissue`][vertax.Tissue].

    **Returns:** a [`PolygonTissue`][vertax.initialise.PolygonTissue]; `.tissue` is the tissue.

    **Raises:**

    - `ValueError`, naming cells and points, for points that are not finite or are the corner of no cell;
        corners that are no number of a point, are repeated in a cell or fewer than three; cells without
        area, that overlap, share a side with two others, or touch in a point only; for cells in several
        pieces or around a hole; for a box that is not filled; for arguments that contradict each other, as a
        box or `inner_arcs` and points with z do; for overhangs.
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`.
    """
    names = Names("Argument `cells`", "point {}".format, "cell {}".format)
    return tissue_from_near_corners(
        points,
        cells,
        names,
        tolerance,
        box=box,
        images=images,
        open_cells=open_cells,
        keep_open=keep_open,
        inner_arcs=inner_arcs,
        softening=softening,
    )


def tissue_from_near_corners(
    points: ArrayLike | Sequence[Any],
    cells: Sequence[Any] | Shaped[np.ndarray | Array, "cells corners"],
    names: Names,
    tolerance: float | None,
    *,
    box: ArrayLike | Sequence[Any] | None,
    images: Sequence[Any] | None = None,
    relative_tolerance: float | None = None,
    **settings: Any,
) -> PolygonTissue:
    """`from_polygons`, with other names for points and cells in messages.

    `relative_tolerance` is the default of `tolerance`, in root mean cell areas.
    """
    check_concrete("from_polygons", points, box, tolerance)
    if tolerance is not None:
        check_number("tolerance", tolerance, at_least=0)
    given, position = _checked_points(points, names)
    corners = _checked_cells(cells, position, names)
    lattice = _checked_box(box, images)
    image = corner_images(images, corners, position, lattice, names)
    size = size_of_cells(position, corners, image, lattice)

    def build(within: float) -> PolygonTissue:
        if within < 0:
            return tissue_from_corners(position, corners, names, box=box, images=images, **settings)
        shared = share_corners(position, corners, image, lattice, within)
        result = tissue_from_corners(
            shared.points,
            shared.cells,
            names._replace(point=lambda point: names.point(int(shared.first[point]))),
            box=box,
            images=None if lattice is None else shared.images,
            **settings,
        )
        return dataclasses.replace(
            result,
            points=shared.first[result.points],
            removed_points=shared.first[result.removed_points],
            split_points=shared.first[result.split_points],
            side_edges=np.append(result.side_edges, -1)[shared.side],
        )

    within = -1.0 if tolerance is None else tolerance
    if tolerance is None and relative_tolerance is not None:
        within = relative_tolerance * size
    return _on_surface(build_within(build, within, size, names.subject), given, names)


def _on_surface(
    result: PolygonTissue, position: Float[np.ndarray, "points dimensions"], names: Names
) -> PolygonTissue:
    """The tissue on the smooth surface through points with z."""
    if position.shape[1] == 2 or np.ptp(position[:, 2]) <= 1e-9 * np.ptp(position[:, :2]):
        return result
    flat = result.tissue
    if not isinstance(flat.boundary, Free) or flat.inner_arcs:
        raise ValueError(
            "Argument `points` must have one z for a periodic tissue or one with inner arcs, but it has "
            "several. Leave out z, or `box` and `inner_arcs`: edges on a surface are chords."
        )
    parts = (flat.vertices, flat.topology, flat.boundary, flat.softening)
    chords = _without_overlaps(dataclasses.replace(result, tissue=Tissue(*parts)), names)
    surface = HeightMap.through(position)
    return dataclasses.replace(chords, tissue=chords.tissue.with_surface(surface))


def tissue_from_corners(
    points: ArrayLike | Sequence[Any],
    cells: Sequence[Any] | Shaped[np.ndarray | Array, "cells corners"],
    names: Names,
    *,
    box: ArrayLike | Sequence[Any] | None,
    images: Sequence[Any] | None = None,
    open_cells: ArrayLike | Sequence[Any] | None = None,
    keep_open: bool = True,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> PolygonTissue:
    """`from_polygons` without `tolerance`, with other names for points and cells in messages."""
    check_concrete("from_polygons", points, box, open_cells, softening)
    in_space, position = _checked_points(points, names)
    corners = _checked_cells(cells, position, names)
    lattice = _checked_box(box, images)
    is_open = _checked_open(open_cells, len(corners))
    if lattice is not None and is_open.any():
        raise ValueError(
            "Argument `open_cells` must name no cells of a periodic tissue, which has no border, but it "
            f"names {int(is_open.sum())}. Leave out `open_cells` or `box`."
        )
    kept = np.flatnonzero(~is_open | bool(keep_open))
    if not kept.size:
        raise ValueError(
            "Argument `open_cells` must leave closed cells if `keep_open` is False, but names all "
            f"{len(corners)}. Pass `keep_open=True`."
        )
    used = np.zeros(len(position), bool)
    used[np.concatenate(corners)] = True
    if not used.all():
        unused = np.flatnonzero(~used)
        raise ValueError(
            f"{names.subject} must use every point, but {names.points(unused)} "
            f"{'is' if unused.size == 1 else 'are'} the corner of no cell. Leave out such points, or give "
            "the missing cells."
        )

    sizes = np.array([len(corners[cell]) for cell in kept])
    of_kept = Names(names.subject, names.point, lambda cell: names.cell(int(kept[cell])))
    sides = Sides(
        np.concatenate([corners[cell] for cell in kept]),
        np.concatenate(
            corner_images(images, [corners[cell] for cell in kept], position, lattice, of_kept)
        ),
        np.repeat(np.arange(len(kept)), sizes),
    )
    sides, given = _counter_clockwise(sides, position, lattice, of_kept)
    mesh = build_faces(position, sides, of_kept, exterior=lattice is None)
    _check_crossings(mesh, sides, position, lattice, of_kept)
    if lattice is not None:
        _check_cover(sides, position, lattice, of_kept)

    topology = mesh.topology
    edge = np.asarray(topology.edge)
    side_edges = np.empty(len(given), int)
    side_edges[given] = edge[mesh.half_edge]
    closing = np.zeros(topology.n_edges, bool)
    closing[side_edges[np.cumsum(sizes)[is_open[kept]] - 1]] = True
    all_sizes = np.array([len(corner) for corner in corners])
    all_edges = np.full(all_sizes.sum(), -1)
    all_edges[np.repeat(np.isin(np.arange(len(corners)), kept), all_sizes)] = side_edges

    dtype = jnp.result_type(float)
    outline = np.asarray(topology.on_outline)
    angles = None
    if lattice is None or inner_arcs:
        curved = outline | inner_arcs
        angles = jnp.asarray(np.where(curved, _angles(mesh, sides, position, lattice), 0), dtype)
    tissue = Tissue(
        jnp.asarray(position[mesh.points], dtype),
        topology,
        Free() if lattice is None else Periodic(jnp.asarray(lattice, dtype)),
        softening,
        angles=angles,
        inner_arcs=inner_arcs,
    )
    result = PolygonTissue(
        tissue=tissue,
        cells=kept,
        points=mesh.points,
        side_edges=all_edges,
        open_cells=is_open[kept],
        closing_edges=closing,
        removed_points=np.flatnonzero(mesh.degree == 2),
        split_points=np.flatnonzero(mesh.degree > 3),
        flattened_edges=np.zeros(topology.n_edges, bool),
    )
    return _on_surface(_without_overlaps(result, of_kept), in_space, names)


def _without_overlaps(result: PolygonTissue, names: Names) -> PolygonTissue:
    """Make arcs flatter where cells overlap; refuse other overlaps."""
    tissue = result.tissue
    inside_out = geometry_of(tissue).areas <= 0
    try:
        flatter = tissue if inside_out.any() else repair_overlaps(tissue)
    except ValueError:
        flatter = None
    moved = flatter is None or not np.array_equal(flatter.vertices, tissue.vertices)
    if flatter is not None and not moved and not inside_out.any():
        if flatter is tissue:
            return result
        flattened = np.asarray(flatter.angles) != np.asarray(tissue.angles)
        return dataclasses.replace(result, tissue=flatter, flattened_edges=flattened)
    bad = np.flatnonzero(np.asarray(tissue.overlaps.cells))
    chords = isinstance(tissue.boundary, Free) and tissue.arcs is None  # on a surface
    names.refuse(
        "hold cells that do not overlap without the points where only two edges meet",
        f"there are overlaps at {names.cells(bad) if bad.size else 'the outline'}: edges without "
        f"{names.points(result.removed_points)} are straight or arcs",
        "Leave out these cells." if chords else "Pass `inner_arcs=True`, or leave out these cells.",
    )


def _check_crossings(
    mesh: FaceMesh,
    sides: Sides,
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
    names: Names,
) -> None:
    """Refuse polygons that cross themselves, and an outline that does."""
    n_sides, n_cells = len(sides.corner), int(sides.cell.max()) + 1
    place = np.concatenate([_places(sides, position, lattice), position[mesh.start[n_sides:]]])
    face = np.append(sides.cell, np.full(len(place) - n_sides, n_cells))
    vectors = place[mesh.following] - place
    crossed = crossed_by(np.concatenate([place, vectors], axis=1), mesh.following, face)
    bad = np.flatnonzero(crossed != np.arange(len(crossed)))
    if not bad.size:
        return
    pair = " and ".join(
        f"from {names.point(int(mesh.start[side]))} to "
        f"{names.point(int(mesh.start[mesh.following[side]]))}"
        for side in (bad[0], crossed[bad[0]])
    )
    owner = "the outline" if face[bad[0]] == n_cells else names.cell(int(face[bad[0]]))
    names.refuse(
        "hold cells that do not overlap",
        f"the sides {pair} of {owner} cross",
        "Correct the order or the positions of the corners.",
    )


def _checked_points(
    points: ArrayLike | Sequence[Any], names: Names
) -> tuple[Float[np.ndarray, "points dimensions"], Float[np.ndarray, "points 2"]]:
    """Positions with two or three coordinates, and the first two of them."""
    array: Shaped[Any, "..."] = np.asarray(points)
    if array.ndim == 2 and array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        raise ValueError(
            f"Argument `points` must be finite, but {names.points(bad)} {'is' if bad.size == 1 else 'are'} "
            "not. Leave out such points and correct the cells that have them."
        )
    position = as_float64("points", points)
    if position.ndim != 2 or position.shape[1] not in (2, 3) or not len(position):
        raise ValueError(
            f"Argument `points` must have shape (points, 2), but has {position.shape}."
        )
    return position, position[:, :2]


def _checked_cells(
    cells: Any, position: Float[np.ndarray, "points 2"], names: Names
) -> list[Int[np.ndarray, " _"]]:
    """The corners of each cell as integers."""
    if isinstance(cells, str) or not hasattr(cells, "__len__"):
        raise TypeError(
            "Argument `cells` must hold the corner numbers of each cell, e.g. [[0, 1, 2], [2, 1, 3]], but is "
            f"{describe(cells)}."
        )
    corners = []
    for cell, given in enumerate(cells):
        corner = np.asarray(given)
        if corner.ndim != 1 or (corner.size and corner.dtype.kind not in "iu"):
            raise TypeError(
                f"{names.subject} must hold integers, the numbers of corners in order, but "
                f"{names.cell(cell)} is {describe(given)}."
            )
        if corner.size < 3:
            raise ValueError(
                f"{names.subject} must have at least three corners each, but {names.cell(cell)} has "
                f"{corner.size}. Leave it out."
            )
        corner = corner.astype(int)
        outside = corner[(corner < 0) | (corner >= len(position))]
        if outside.size:
            raise ValueError(
                f"{names.subject} must hold numbers of points, 0 … {len(position) - 1}, but "
                f"{names.cell(cell)} has the corner {int(outside[0])}. If numbers begin at 1, subtract 1."
            )
        corners.append(corner)
    if not corners:
        raise ValueError(f"{names.subject} must hold at least one cell, but is empty.")
    return corners


def _checked_box(
    box: ArrayLike | Sequence[Any] | None, images: Sequence[Any] | None
) -> Float[np.ndarray, "2 2"] | None:
    if box is None and images is not None:
        raise ValueError(
            "Argument `images` must come with `box`, but there is none. Pass the box of the periodic tissue."
        )
    return None if box is None else as_lattice(box)


def _checked_open(
    open_cells: ArrayLike | Sequence[Any] | None, n_cells: int
) -> Bool[np.ndarray, " cells"]:
    is_open = np.zeros(n_cells, bool)
    if open_cells is None:
        return is_open
    given = np.asarray(open_cells)
    if given.dtype.kind == "b" and given.shape == (n_cells,):
        return given.copy()
    integers = given.ndim == 1 and (given.size == 0 or given.dtype.kind in "iu")
    if not integers or (given.size and (given.min() < 0 or given.max() >= n_cells)):
        raise ValueError(
            f"Argument `open_cells` must hold numbers of cells, 0 … {n_cells - 1}, or one boolean for each "
            f"cell, but is {describe(open_cells)}."
        )
    is_open[given.astype(int)] = True
    return is_open


def corner_images(
    images: Sequence[Any] | None,
    corners: list[Int[np.ndarray, " _"]],
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
    names: Names,
) -> list[Int[np.ndarray, "_ 2"]]:
    """Lattice images of the corners of each cell; corners repeated in a cell are refused."""
    if lattice is None:
        arrays = [np.zeros((len(corner), 2), int) for corner in corners]
    elif images is None:
        arrays = [_nearest_images(position[corner], lattice) for corner in corners]
    else:
        arrays = [np.asarray(image) for image in images]
        shapes = [(len(corner), 2) for corner in corners]
        if [image.shape for image in arrays] != shapes or any(
            image.dtype.kind not in "iu" for image in arrays
        ):
            raise ValueError(
                "Argument `images` must hold integers of shape (corners, 2) for each of the cells, but does "
                "not. Give the lattice image of each corner."
            )
    for cell, (corner, image) in enumerate(zip(corners, arrays, strict=True)):
        both = np.column_stack([corner, image])
        unique, first = np.unique(both, axis=0, return_index=True)
        if len(unique) < len(both):
            bad = corner[np.setdiff1d(np.arange(len(corner)), first)]
            raise ValueError(
                f"{names.subject} must not repeat a corner, but {names.cell(cell)} has "
                f"{names.points(bad)} more than once. "
                + (
                    "Leave out the first corner at the end, and corners to which the outline returns."
                    if lattice is None or images is not None
                    else "If they are different lattice images, give the `images` of the corners."
                )
            )
    return [array.astype(int) for array in arrays]


def _nearest_images(
    polygon: Float[np.ndarray, "corners 2"],
    lattice: Float[np.ndarray, "2 2"],
) -> Int[np.ndarray, "corners 2"]:
    """Images of the corners of a cell: its sides take the shortest way, and its outline is closed."""
    side = np.roll(polygon, -1, axis=0) - polygon
    near = -np.rint(side @ np.linalg.inv(lattice))
    # In a leaning box a neighbour of the image in the parallelogram around 0 may be closer.
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    choices = near[:, None] + steps
    length = np.linalg.norm(side[:, None] + choices @ lattice, axis=-1)
    best = np.argmin(length - 1e-9 * np.all(steps == 0, axis=1) * np.max(length), axis=1)
    step = choices[np.arange(len(side)), best].astype(int)
    if (gap := step.sum(axis=0)).any():
        # A side is longer than half the box: that with the least detour by the image that closes the outline.
        detour = np.linalg.norm(side + (step - gap) @ lattice, axis=1) - np.min(length, axis=1)
        step[np.argmin(detour)] -= gap
    return np.cumsum(step, axis=0) - step


def _places(
    sides: Sides, position: Float[np.ndarray, "points 2"], lattice: Float[np.ndarray, "2 2"] | None
) -> Float[np.ndarray, "sides 2"]:
    """Where each side begins, in the frame of its cell."""
    place = position[sides.corner]
    return place if lattice is None else place + sides.image @ lattice


def _counter_clockwise(
    sides: Sides,
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
    names: Names,
) -> tuple[Sides, Int[np.ndarray, " sides"]]:
    """The sides with all cells counter-clockwise, and which of the given sides each is."""
    place = _places(sides, position, lattice)
    count = np.bincount(sides.cell)
    first = np.cumsum(count) - count
    # Relative to a corner of the cell: the formula loses digits far from the origin.
    place = place - place[first][sides.cell]
    area = np.bincount(sides.cell, 0.5 * cross(place, place[sides.following]))
    extent = np.maximum.reduceat(np.abs(place).max(axis=1), first)
    empty = np.flatnonzero(~(np.abs(area) > 1e-12 * extent**2))
    if empty.size:
        names.refuse(
            "enclose areas",
            f"the area of {names.cells(empty)} is 0",
            "Leave out these cells, or correct the order of their corners.",
        )
    clockwise = (area < 0)[sides.cell]
    size, begin = count[sides.cell], first[sides.cell]
    local = np.arange(len(begin)) - begin
    order = np.where(clockwise, begin + size - 1 - local, begin + local)
    given = np.where(clockwise, begin + (size - 2 - local) % size, begin + local)
    return Sides(sides.corner[order], sides.image[order], sides.cell), given


def _check_cover(
    sides: Sides,
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"],
    names: Names,
) -> None:
    place = _places(sides, position, lattice)
    cover = 0.5 * np.sum(cross(place, place[sides.following])) / np.linalg.det(lattice)
    if abs(cover - 1) > 1e-6:
        names.refuse(
            "fill the periodic box once",
            f"their areas sum to {cover:.6g} of its area",
            "Check `box`. Where sides are longer than half the box, give the `images` of the corners.",
        )


def _angles(
    mesh: FaceMesh,
    sides: Sides,
    position: Float[np.ndarray, "points 2"],
    lattice: Float[np.ndarray, "2 2"] | None,
) -> Float[np.ndarray, " edges"]:
    """Angles of arcs that bound the areas which the chains of sides bound."""
    half_edge = np.asarray(mesh.topology.half_edge)
    place = _places(sides, position, lattice)
    end = place[sides.following]
    # The first side of each half-edge gives the origin, the last one the end of the chord.
    n_half = mesh.topology.n_half_edges
    origin, target = np.zeros((n_half, 2)), np.zeros((n_half, 2))
    begins = mesh.rank == 0
    origin[mesh.half_edge[begins]] = place[begins]
    order = np.argsort(mesh.rank, kind="stable")
    target[mesh.half_edge[order]] = end[order]
    rest = place - origin[mesh.half_edge]
    swept = 0.5 * cross(rest, end - origin[mesh.half_edge])
    bulge = np.bincount(mesh.half_edge, np.where(begins, 0, swept), n_half)
    chord = np.linalg.norm(target - origin, axis=1)
    return angle_of_area(bulge[half_edge], chord[half_edge])
