"""Tissues from the corners of their cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import vertax as vx

# Two unit squares side by side.
POINTS = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [1, 1], [0, 1]], float)
CELLS = [[0, 1, 4, 5], [1, 2, 3, 4]]


def corners_of(tissue: vx.Tissue) -> tuple[list[list[int]], list[np.ndarray]]:
    """The vertex numbers of each cell in order, and the lattice images of these corners."""
    m = tissue.topology
    cell, following, frame = np.asarray(m.cell), np.asarray(m.next), np.asarray(m.frame)
    cells, images = [], []
    for number in range(tissue.n_cells):
        half_edges = [int(np.flatnonzero(cell == number)[0])]
        while following[half_edges[-1]] != half_edges[0]:
            half_edges.append(int(following[half_edges[-1]]))
        cells.append([h // 3 for h in half_edges])
        images.append(frame[half_edges])
    return cells, images


def squares(n: int, periodic: bool) -> tuple[np.ndarray, list[list[int]]]:
    """A lattice of unit squares and the corners of its cells: `n` cells or points in a row."""
    wrapped = lambda i, j: n * (i % n) + j % n
    points = np.array([(i, j) for i in range(n) for j in range(n)], float)
    last = n if periodic else n - 1
    cells = [
        [wrapped(i, j), wrapped(i + 1, j), wrapped(i + 1, j + 1), wrapped(i, j + 1)]
        for i in range(last)
        for j in range(last)
    ]
    return points, cells


def neighbours(tissue: vx.Tissue) -> set[tuple[int, ...]]:
    return {tuple(sorted(pair)) for pair in np.asarray(tissue.topology.edge_cells).tolist()}


def test_two_cells():
    result = vx.initialise.from_polygons(POINTS, CELLS)
    tissue = result.tissue
    assert (tissue.n_cells, tissue.n_vertices, tissue.n_edges) == (2, 2, 3)
    # The outline of each cell is an arc with the area of its three sides.
    np.testing.assert_allclose(tissue.areas, [1, 1], rtol=1e-12)
    np.testing.assert_array_equal(result.points, [1, 4])
    np.testing.assert_array_equal(result.removed_points, [0, 2, 3, 5])
    np.testing.assert_array_equal(result.cells, [0, 1])
    inner = int(np.flatnonzero(~np.asarray(tissue.topology.on_outline))[0])
    np.testing.assert_array_equal(np.flatnonzero(result.side_edges == inner), [1, 7])
    assert not result.open_cells.any()
    assert not result.closing_edges.any()
    assert not result.flattened_edges.any()
    assert not tissue.overlaps.any


@given(flipped=st.lists(st.booleans(), min_size=6, max_size=6), shift=st.integers(0, 5))
@settings(max_examples=15, deadline=None)
def test_sense_of_rotation_and_first_corner_do_not_matter(flipped, shift):
    tissue = vx.initialise.periodic_voronoi(6, key=3, lloyd_steps=2)
    lattice = np.asarray(tissue.boundary.lattice)
    cells, images = corners_of(tissue)
    turned, turned_images = [], []
    for cell, image, flip in zip(cells, images, flipped, strict=True):
        step = -1 if flip else 1
        turned.append(np.roll(cell, shift)[::step])
        turned_images.append(np.roll(image, shift, axis=0)[::step])
    result = vx.initialise.from_polygons(
        tissue.vertices, turned, box=lattice, images=turned_images, softening=0.0
    )
    np.testing.assert_array_equal(result.tissue.vertices, tissue.vertices)
    np.testing.assert_allclose(result.tissue.areas, tissue.areas, rtol=1e-12)
    np.testing.assert_array_equal(result.tissue.neighbour_counts, tissue.neighbour_counts)
    # Each side belongs to the edge between its two corners.
    ends = np.sort(np.asarray(result.tissue.topology.edge_vertices)[result.side_edges], axis=1)
    sides = np.concatenate([np.column_stack([cell, np.roll(cell, -1)]) for cell in turned])
    np.testing.assert_array_equal(ends, np.sort(sides, axis=1))


# A cell of the other tissue has a side longer than half the box.
@pytest.mark.parametrize(("n", "lattice"), [(40, [[6.0, 0.0], [2.5, 7.0]]), (9, 3 * np.eye(2))])
def test_sides_take_the_shortest_way_through_a_periodic_box(n, lattice):
    tissue = vx.initialise.periodic_voronoi(n, key=3, lattice=np.array(lattice))
    result = vx.initialise.from_polygons(
        tissue.vertices, corners_of(tissue)[0], box=tissue.boundary.lattice
    )
    np.testing.assert_allclose(result.tissue.areas, tissue.areas, rtol=1e-12)
    np.testing.assert_array_equal(result.points, np.arange(tissue.n_vertices))
    assert neighbours(result.tissue) == neighbours(tissue)


def test_free_tissue_with_straight_edges():
    clusters = (vx.initialise.free_voronoi(15, key=key, lloyd_steps=2) for key in range(9))
    tissue = next(cluster for cluster in clusters if cluster.neighbour_counts.min() > 2)
    straight = tissue.with_angles(jnp.zeros(tissue.n_edges))
    result = vx.initialise.from_polygons(straight.vertices, corners_of(straight)[0])
    np.testing.assert_array_equal(result.tissue.vertices, tissue.vertices)
    np.testing.assert_array_equal(result.tissue.angles, 0)
    np.testing.assert_allclose(result.tissue.areas, straight.areas, rtol=1e-12)
    assert neighbours(result.tissue) == neighbours(tissue)


def test_points_inside_an_inner_edge_are_removed():
    points = np.vstack([POINTS, [1.2, 0.5]])
    cells = [[0, 1, 6, 4, 5], [1, 2, 3, 4, 6]]
    straight = vx.initialise.from_polygons(points, cells)
    np.testing.assert_array_equal(straight.removed_points, [0, 2, 3, 5, 6])
    arcs = vx.initialise.from_polygons(points, cells, inner_arcs=True)
    # A triangle of area 0.1 goes from one cell to the other.
    np.testing.assert_allclose(arcs.tissue.areas, [1.1, 0.9], rtol=1e-12)
    np.testing.assert_allclose(straight.tissue.areas, [1.1 - 0.1, 0.9 + 0.1], rtol=1e-12)


def test_fourfold_points_are_split():
    points, cells = squares(3, periodic=True)
    result = vx.initialise.from_polygons(points, cells, box=(3, 3))
    tissue = result.tissue
    assert (tissue.n_vertices, tissue.n_edges) == (18, 27)
    np.testing.assert_array_equal(result.split_points, np.arange(9))
    np.testing.assert_array_equal(result.points, np.repeat(np.arange(9), 2))
    np.testing.assert_allclose(tissue.areas, 1, rtol=1e-12)
    assert np.sum(np.asarray(tissue.edge_lengths) < 0.01) == 9
    assert not tissue.overlaps.any
    # The cell of the lowest number touches its opposite.
    assert (0, 4) in neighbours(tissue)
    assert (1, 3) not in neighbours(tissue)


def test_a_split_point_on_the_outline_adds_no_outline():
    fan = [[0, 0], [2, 0], [1, 2], [-1, 2], [-2, 0]]
    result = vx.initialise.from_polygons(fan, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    np.testing.assert_array_equal(result.split_points, [0])
    lengths = np.asarray(result.tissue.edge_lengths)
    assert not np.asarray(result.tissue.topology.on_outline)[np.argmin(lengths)]


def test_a_hole_is_refused():
    points, cells = squares(4, periodic=False)
    del cells[4]
    with pytest.raises(
        ValueError, match="enclose no hole, but there is one with the corners point 5"
    ):
        vx.initialise.from_polygons(points, cells)


def test_six_cells_at_a_point():
    angle = np.pi / 3 * np.arange(6)
    points = np.vstack([[0, 0], np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    result = vx.initialise.from_polygons(points, [[0, k + 1, (k + 1) % 6 + 1] for k in range(6)])
    assert np.sum(result.points == 0) == 4
    np.testing.assert_allclose(result.tissue.areas, np.sqrt(3) / 4, rtol=1e-12)
    assert {(0, k) for k in range(1, 6)} <= neighbours(result.tissue)
    assert not result.tissue.overlaps.any


def test_open_cells_are_closed_or_left_out():
    # A row of three squares; the outer ones have no side at the ends of the row.
    points = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [3, 1], [2, 1], [1, 1], [0, 1]], float)
    cells = [[0, 1, 6, 7], [1, 2, 5, 6], [4, 5, 2, 3]]
    result = vx.initialise.from_polygons(points, cells, open_cells=[0, 2])
    np.testing.assert_array_equal(result.open_cells, [True, False, True])
    closing = np.asarray(result.tissue.topology.edge_cells)[result.closing_edges]
    np.testing.assert_array_equal(np.sort(closing, axis=None), [0, 2, 3, 3])
    np.testing.assert_allclose(result.tissue.areas, 1, rtol=1e-12)
    with pytest.raises(ValueError, match="three at a point"):
        vx.initialise.from_polygons(points, cells, open_cells=[0, 2], keep_open=False)
    points, cells = squares(4, periodic=False)
    is_open = np.arange(9) == 8
    result = vx.initialise.from_polygons(points, cells, open_cells=is_open, keep_open=False)
    np.testing.assert_array_equal(result.cells, np.arange(8))
    np.testing.assert_array_equal(result.side_edges[-4:], -1)
    assert (result.side_edges[:-4] >= 0).all()


def test_arcs_are_flattened_where_cells_would_overlap():
    # Below and to the right of a square a long triangle each: arcs of their areas would cross.
    points = [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, -6], [7, 0.5]]
    result = vx.initialise.from_polygons(points, [[0, 1, 2, 3], [0, 4, 1], [1, 5, 2]])
    assert not result.tissue.overlaps.any
    outline = np.asarray(result.tissue.topology.on_outline)
    assert result.flattened_edges[outline].any()
    assert not result.flattened_edges[~outline].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"points": POINTS * [[1, np.nan]]},
            "`points` must be finite, but point 0, .* and point 5 are not",
        ),
        ({"points": POINTS[:, :1]}, r"`points` must have shape \(points, 2\)"),
        (
            {"points": np.vstack([POINTS, [5, 5]])},
            "use every point, but point 6 is the corner of no cell",
        ),
        ({"cells": [[0, 1, 4, 5], [1, 2]]}, "three corners each, but cell 1 has 2"),
        (
            {"cells": [[0, 1, 4, 5], [1, 2, 3, 6]]},
            "0 … 5, but cell 1 has the corner 6. .* begin at 1",
        ),
        (
            {"cells": [[0, 1, 4, 5, 0], [1, 2, 3, 4]]},
            "not repeat a corner, but cell 0 has point 0",
        ),
        (
            {"cells": [[0, 1, 4, 5], [1, 2, 3, 4], [1, 2, 4]]},
            "do not overlap, but cell 1 and cell 2 are on the",
        ),
        ({"cells": []}, "at least one cell"),
        ({"cells": [[0, 1, 2], [2, 3, 4, 5]]}, "enclose areas, but the area of cell 0 is 0"),
        ({"open_cells": [2]}, r"`open_cells` must hold numbers of cells, 0 … 1"),
        ({"open_cells": [0, 1], "keep_open": False}, "`open_cells` must leave closed cells"),
        ({"images": [[[0, 0]]]}, "`images` must come with `box`"),
        ({"box": (9, 9)}, "fill the periodic box, but the side from point .* belongs to cell"),
        ({"box": (2, -1)}, "`box` must have a positive area"),
        ({"box": (2, 2, 2)}, r"`box` must be width and height"),
        (
            {"box": (9, 9), "open_cells": [0]},
            "`open_cells` must name no cells of a periodic tissue",
        ),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {"points": POINTS, "cells": CELLS} | change
    with pytest.raises(ValueError, match=message):
        vx.initialise.from_polygons(**arguments)


def test_sides_of_three_cells_are_refused():
    points = np.vstack([POINTS, [0.5, 0.5]])
    with pytest.raises(
        ValueError, match="side from point 1 to point 4 belongs to cell 0, cell 1 and cell 2"
    ):
        vx.initialise.from_polygons(points, [*CELLS, [1, 4, 6]])


@pytest.mark.usefixtures("without_type_checks")
def test_wrong_types_are_refused():
    with pytest.raises(TypeError, match="`cells` must hold the corner numbers of each cell"):
        vx.initialise.from_polygons(POINTS, 7)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"`cells` must hold integers.*cell 0 is"):
        vx.initialise.from_polygons(POINTS, [[0.5, 1.0, 4.0]])
    with pytest.raises(TypeError, match=r"jax\.jit"):
        jax.jit(lambda p: vx.initialise.from_polygons(p, CELLS).tissue)(POINTS)


def test_cells_apart_are_refused():
    far = np.vstack([POINTS, POINTS + 5])
    both = [*CELLS, *([corner + 6 for corner in cell] for cell in CELLS)]
    with pytest.raises(ValueError, match="one piece, but cell 2 and cell 3 have no side in common"):
        vx.initialise.from_polygons(far, both)
    # No corner is shared.
    doubled = POINTS[np.concatenate(CELLS)]
    with pytest.raises(ValueError, match=r"share corners .*`tolerance=1e-06`"):
        vx.initialise.from_polygons(doubled, [[0, 1, 2, 3], [4, 5, 6, 7]])


@pytest.mark.parametrize("digits", [2, 3, 5])
@pytest.mark.parametrize("periodic", [False, True])
def test_error_names_the_tolerance_within_which_cells_share_corners(digits, periodic):
    make = vx.initialise.periodic_voronoi if periodic else vx.initialise.free_voronoi
    tissue = make(30, key=5, lloyd_steps=3)
    cells, images = corners_of(tissue)
    lattice = np.asarray(tissue.boundary.lattice) if periodic else None
    # Each cell has rounded corners, and its number of a corner is not that of its neighbours.
    corner = np.asarray(tissue.vertices)[np.concatenate(cells)]
    shift = np.concatenate(images) @ lattice if lattice is not None else 0
    corner = np.round(corner + shift + np.pi, digits) + 0.3 * 10.0**-digits * np.sin(
        np.arange(2 * len(corner)).reshape(-1, 2)
    )
    apart = np.split(np.arange(len(corner)), np.cumsum([len(cell) for cell in cells])[:-1])
    with pytest.raises(ValueError, match=r"share corners .* Pass `tolerance=") as error:
        vx.initialise.from_polygons(corner, apart, box=lattice)
    tolerance = float(str(error.value).partition("`tolerance=")[2].partition("`")[0])
    assert 10.0**-digits <= tolerance <= 20 * 10.0**-digits
    result = vx.initialise.from_polygons(corner, apart, tolerance=tolerance, box=lattice)
    again = result.tissue
    if 3 * tolerance < np.min(tissue.edge_lengths):
        assert neighbours(again) == neighbours(tissue)
    x, y = np.split(corner, 2, axis=1)
    areas = [0.5 * abs(np.sum(x[c] * np.roll(y[c], -1) - y[c] * np.roll(x[c], -1))) for c in apart]
    np.testing.assert_allclose(again.areas, areas, atol=3 * tolerance)
    # Points and sides have the numbers of the given ones.
    np.testing.assert_array_equal(corner[result.points], again.vertices)
    assert len(result.side_edges) == len(corner)
    ends = np.asarray(again.topology.edge_cells)[result.side_edges]
    owner = np.repeat(np.arange(30), [len(cell) for cell in apart])
    has_length = result.side_edges >= 0
    assert np.any(ends == owner[:, None], axis=1)[has_length].all()
    assert np.count_nonzero(~has_length) <= 4


@pytest.mark.parametrize("periodic", [False, True])
def test_corners_on_the_side_of_a_neighbour_are_added_to_it(periodic):
    # Rows of bricks: a brick has the corners of its neighbours in the middle of two sides.
    rows, columns = 4, 4
    bricks = [
        [[x, y], [x + 2, y], [x + 2, y + 1], [x, y + 1]]
        for y in range(rows)
        for x in range(y % 2, 2 * columns + y % 2, 2)
    ]
    points = np.reshape(bricks, (-1, 2)) + 1e-4 * np.sin(np.arange(8 * len(bricks))).reshape(-1, 2)
    cells = np.arange(len(points)).reshape(-1, 4)
    box = (2 * columns, rows) if periodic else None
    with pytest.raises(ValueError, match=r"Pass `tolerance=0\.000"):
        vx.initialise.from_polygons(points, cells, box=box)
    tissue = vx.initialise.from_polygons(points, cells, box=box, tolerance=1e-3).tissue
    np.testing.assert_allclose(tissue.areas, 2, rtol=1e-3)
    if periodic:
        np.testing.assert_array_equal(tissue.neighbour_counts, 6)
    else:
        np.testing.assert_array_equal(tissue.neighbour_counts[5:7], 6)


def test_cells_that_touch_in_a_point_are_refused():
    points = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [3, 1], [2, 2], [1.5, 2]], float)
    with pytest.raises(ValueError, match=r"touch along sides, but .* touch in point 4 only"):
        vx.initialise.from_polygons(points, [[0, 1, 4, 3], [1, 2, 4], [4, 5, 6, 7]])


def test_polygons_that_cross_themselves_are_refused():
    points = POINTS.copy()
    points[1], points[4] = [1.0, 1.2], [1.0, -0.1]
    message = "do not overlap, but the sides from point . to point . and from point . to point . of cell 0"
    with pytest.raises(ValueError, match=message):
        vx.initialise.from_polygons(points, CELLS)


def test_an_outline_that_crosses_itself_is_refused():
    # A row of squares in a ring that meets itself, with the ends on top of each other.
    angle = np.linspace(0, 2.2 * np.pi, 24)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([ring, (2.0 + 0.05 * angle[:, None]) * ring])
    cells = [[k, k + 24, k + 25, k + 1] for k in range(23)]
    with pytest.raises(ValueError, match=r"not overlap, but the sides .* of the outline cross"):
        vx.initialise.from_polygons(points, cells)


def test_edges_that_overlap_without_removed_points_are_refused():
    # A cell in a notch of the other one, with a notch itself: a straight interface leaves it no area.
    points = [[0, 0], [4, 0], [4, 3], [0, 3], [1, 3], [1, 1], [3, 1], [3, 3], [2, 1.5]]
    cells = [[0, 1, 2, 7, 6, 5, 4, 3], [4, 5, 6, 7, 8]]
    with pytest.raises(
        ValueError, match=r"without the points .* overlaps at .*cell 1: .*`inner_arcs=True`"
    ):
        vx.initialise.from_polygons(points, cells)
    result = vx.initialise.from_polygons(points, cells, inner_arcs=True)
    np.testing.assert_allclose(result.tissue.areas, [8, 2.5], rtol=1e-9)
    assert not result.tissue.overlaps.any


def test_a_box_that_is_too_small_for_the_shortest_way_needs_images():
    tissue = vx.initialise.periodic_voronoi(2, key=1)
    cells, images = corners_of(tissue)
    box = tissue.boundary.lattice
    result = vx.initialise.from_polygons(tissue.vertices, cells, box=box, images=images)
    np.testing.assert_allclose(result.tissue.areas, tissue.areas, rtol=1e-12)
    with pytest.raises(ValueError, match="the `images` of the corners"):
        vx.initialise.from_polygons(tissue.vertices, cells, box=box)
    with pytest.raises(ValueError, match="`images` must hold integers of shape"):
        vx.initialise.from_polygons(tissue.vertices, cells, box=box, images=images[:1])
