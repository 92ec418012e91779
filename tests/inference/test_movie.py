"""Movies of tracked cells, and the events between their frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from movie_helpers import rows_of, table_of

import vertax as vx
from vertax.inference import Event, Movie, Repair, movie_from_table

CLUSTER = vx.initialise.free_voronoi(20, key=jax.random.key(4), lloyd_steps=20)
STRAIGHT = CLUSTER.with_angles(jnp.zeros(CLUSTER.n_edges))
_outline = np.asarray(STRAIGHT.topology.edge_cells)[np.asarray(STRAIGHT.topology.on_outline), 0]
INNER = [cell for cell in range(20) if cell not in _outline]


def test_cells_without_events_keep_their_places():
    moved = STRAIGHT.with_vertices(STRAIGHT.vertices + 0.1)
    types = {"type": np.arange(20) % 2}
    movie = movie_from_table(table_of(rows_of(STRAIGHT, 3, **types) + rows_of(moved, 7, **types)))
    assert movie.events == ()
    np.testing.assert_array_equal(movie.times, [3, 7])
    np.testing.assert_array_equal(movie.types, np.arange(20) % 2)
    np.testing.assert_allclose(movie.frame(0).areas, STRAIGHT.areas, rtol=1e-12)
    np.testing.assert_allclose(movie.frame(1).centroids, moved.centroids, rtol=1e-12)


def test_a_table_may_be_a_file(tmp_path):
    vx.io.write_csv(tmp_path / "cells.csv", table_of(rows_of(STRAIGHT, 0) + rows_of(STRAIGHT, 1)))
    movie = movie_from_table(str(tmp_path / "cells.csv"))
    np.testing.assert_allclose(movie.frame(1).areas, STRAIGHT.areas, rtol=1e-12)


def test_corners_at_whole_pixels_are_joined_across_the_box():
    tissue = vx.initialise.periodic_voronoi(12, key=jax.random.key(2))
    scale = 100.0
    table = table_of(rows_of(tissue, 0) + rows_of(tissue, 1))
    table |= {axis: np.round(scale * table[axis]) for axis in "xy"}
    movie = movie_from_table(table, box=scale * np.asarray(tissue.boundary.lattice))
    np.testing.assert_allclose(movie.frame(1).areas, scale**2 * tissue.areas, rtol=0.05)


def test_cells_are_matched_by_number_in_any_order():
    numbers = 5 + 3 * np.random.default_rng(0).permutation(20)
    order = rows_of(STRAIGHT, 0, numbers)
    movie = movie_from_table(table_of(order + rows_of(STRAIGHT, 1, numbers)[::-1]))
    np.testing.assert_array_equal(movie.cells, np.sort(numbers))
    by_number = np.asarray(STRAIGHT.areas)[np.argsort(numbers)]
    for frame in range(2):
        movie.frame(frame).topology.validate()
        np.testing.assert_allclose(movie.frame(frame).areas, by_number, rtol=1e-12)
    assert movie.events == ()


def test_cells_of_a_periodic_box_are_matched_across_its_boundary():
    tissue = vx.initialise.periodic_voronoi(12, key=jax.random.key(2))
    moved = tissue.with_vertices(tissue.vertices + 0.4)  # corners leave the box
    table = table_of(rows_of(tissue, 0) + rows_of(moved, 1))
    movie = movie_from_table(table, box=tissue.boundary.lattice)
    assert movie.events == ()
    for frame, original in enumerate((tissue, moved)):
        np.testing.assert_allclose(movie.frame(frame).areas, original.areas, rtol=1e-9)
        assert movie.frame(frame).n_vertices == tissue.n_vertices


@pytest.mark.thorough
def test_t1_transition_is_recognised():
    tissue = vx.initialise.periodic_voronoi(36, key=jax.random.key(2))
    end = vx.equilibrate(tissue, vx.energies.ShapeFactorEnergy(3.8)).tissue
    assert not np.array_equal(tissue.topology.edge_cells, end.topology.edge_cells)
    movie = Movie([tissue, end], [0, 1], largest_jump=2.0)
    contacts = lambda t: {frozenset(p) for p in np.asarray(t.topology.edge_cells).tolist()}
    lost, gained = contacts(tissue) - contacts(end), contacts(end) - contacts(tissue)
    listed = [frozenset(e.cells[:2]) for e in movie.events if e.kind in ("T1", "contact lost")]
    assert lost
    assert sorted(map(sorted, listed)) == sorted(map(sorted, lost))
    new = [frozenset(e.cells[2:]) for e in movie.events if e.kind == "T1"]
    new += [frozenset(e.cells) for e in movie.events if e.kind == "contact gained"]
    assert sorted(map(sorted, new)) == sorted(map(sorted, gained))


@pytest.mark.thorough
@pytest.mark.parametrize("keeps_number", [True, False])
def test_division_is_recognised(keeps_number):
    mother, start = INNER[0], STRAIGHT.with_capacity(21)
    divided = vx.transitions.divide(start, mother).tissue.without_spare()
    numbers = np.arange(21)
    if not keeps_number:
        numbers[mother] = 40
    movie = Movie([STRAIGHT, divided], [0, 1], cells=[np.arange(20), numbers])
    daughters = {int(numbers[mother]), 20}
    (event,) = [e for e in movie.events if e.kind == "division"]
    assert (event.frame, event.cells[0]) == (1, mother)
    assert set(event.cells[1:]) == daughters
    assert not any(e.kind in ("death", "entry") for e in movie.events)
    n_alive = [int(movie.frame(k).alive.sum()) for k in range(2)]
    assert n_alive == [20, 21]
    np.testing.assert_allclose(movie.frame(0).areas.sum(), STRAIGHT.areas.sum(), rtol=1e-12)


@pytest.mark.thorough
def test_death_is_recognised():
    dead = INNER[0]
    removed = vx.transitions.remove(STRAIGHT.with_capacity(20), dead).tissue.without_spare()
    rest = np.delete(np.arange(20), dead)
    movie = Movie([STRAIGHT, removed], [0, 1], cells=[np.arange(20), rest], largest_jump=2.0)
    assert Event("death", 1, (dead,)) in movie.events
    assert not movie.frame(1).alive[dead]


def test_a_cell_that_is_missing_for_a_frame_fills_the_hole():
    missing = INNER[0]
    frames = rows_of(STRAIGHT, 0) + rows_of(STRAIGHT, 1, leave_out=[missing]) + rows_of(STRAIGHT, 2)
    movie = movie_from_table(table_of(frames))
    assert movie.events == (Event("gap", 1, (missing,)),)
    np.testing.assert_allclose(movie.frame(1).areas, STRAIGHT.areas, rtol=1e-12)


def test_a_cell_at_the_border_may_be_missing():
    missing = int(_outline[0])
    gap = rows_of(STRAIGHT, 1, leave_out=[missing])
    movie = movie_from_table(table_of(rows_of(STRAIGHT, 0) + gap + rows_of(STRAIGHT, 2)))
    assert Event("gap", 1, (missing,)) in movie.events
    assert not any(event.kind in ("exit", "death", "entry") for event in movie.events)


def test_cells_that_jump_are_named():
    numbers = np.arange(20)
    numbers[[0, 19]] = [19, 0]
    with pytest.raises(
        ValueError, match=r"must not jump, but in frame 1 cell (0|19) is .* cell sizes"
    ):
        Movie([STRAIGHT, STRAIGHT], [0, 1], cells=[np.arange(20), numbers])


def test_numbers_that_are_used_again_are_named():
    far = np.asarray(STRAIGHT.centroids)
    first = int(_outline[0])
    away = np.linalg.norm(far - far[first], axis=1)
    other = max((int(c) for c in _outline), key=lambda c: away[c])
    again = np.arange(20)
    again[other], again[first] = first, 50
    frames = rows_of(STRAIGHT, 0) + rows_of(STRAIGHT, 1, leave_out=[first])
    with pytest.raises(ValueError, match=f"lost cell again, but in frame 2 cell {first} "):
        movie_from_table(table_of(frames + rows_of(STRAIGHT, 2, again)))


def test_bad_tables_are_named():
    first, second = rows_of(STRAIGHT, 0), rows_of(STRAIGHT, 1)
    with pytest.raises(
        ValueError, match="`frame` of argument `table` must ascend, but frame 0 follows"
    ):
        movie_from_table(table_of(second + first))
    with pytest.raises(ValueError, match="cell 3 appears twice in frame 1"):
        movie_from_table(
            table_of(
                first
                + second
                + [{**row, "frame": 1, "x": row["x"] + 3} for row in first if row["cell"] == 3]
            )
        )
    with pytest.raises(ValueError, match="must have a column `cell`"):
        movie_from_table({"frame": [0, 1]})
    mixed = [{**row, "type": int(k == 0)} for k, row in enumerate(first + second)]
    with pytest.raises(ValueError, match="one type per cell, but cell 0 has several"):
        movie_from_table(table_of(mixed))


def test_polygons_that_overlap_are_named():
    squares = [[0, 0, 1, 0, 1, 1, 0, 1], [0.5, 0.2, 2, 0, 2, 1, 0.5, 0.8]]
    rows = [
        {"frame": f, "cell": c, "x": x, "y": y}
        for f in range(2)
        for c, square in enumerate(squares)
        for x, y in np.reshape(square, (-1, 2))
    ]
    with pytest.raises(ValueError, match="Frame 0 of argument `table` must"):
        movie_from_table(table_of(rows))


def test_copies_repeated_corners_and_turned_cells_are_mended():
    first, second = rows_of(STRAIGHT, 0), rows_of(STRAIGHT, 1)
    of = lambda cell: [row for row in second if row["cell"] == cell]
    kept = [row for row in second if row["cell"] not in (2, 5, 8)]
    # Cell 2 is clockwise, cell 5 has its first corner again, cells 8 and 9 are there twice.
    rows = kept + of(2)[::-1] + [*of(5), of(5)[0]] + 2 * of(8) + of(9)
    movie = movie_from_table(table_of(first + rows))
    np.testing.assert_allclose(movie.frame(1).areas, STRAIGHT.areas, rtol=1e-12)
    expected = {"clockwise": (2,), "repeated corner": (5,), "listed twice": (8, 9)}
    assert {repair.kind: repair.cells for repair in movie.repairs} == expected
    assert all(repair.frame == 1 for repair in movie.repairs)


def test_corners_on_sides_of_neighbours_are_inserted():
    squares = {
        0: [0, 0, 2, 0, 2, 1, 0, 1],
        1: [0, 1, 1, 1, 1, 2, 0, 2],
        2: [1, 1, 2, 1, 2, 2, 1, 2],
    }
    rows = [
        {"frame": f, "cell": c, "x": x, "y": y}
        for f in range(2)
        for c, square in squares.items()
        for x, y in np.reshape(square, (-1, 2))
    ]
    movie = movie_from_table(table_of(rows))
    assert movie.repairs == (Repair("inserted corner", 0, (0,)), Repair("inserted corner", 1, (0,)))
    # A copy of a square, and a square that is run through twice.
    copies = [row | {"frame": 1} for row in rows[:4] + rows[4:8]]
    movie = movie_from_table(table_of(rows + copies))
    assert movie.repairs[-1] == Repair("listed twice", 1, (0, 1))
    np.testing.assert_allclose(movie.frame(1).areas, [2, 1, 1], rtol=1e-12)


@pytest.mark.parametrize("n_cells", [12, pytest.param(100, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("digits", [6, 4, 3])
def test_rounded_corners_of_a_periodic_box_are_joined(n_cells, digits):
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(2))
    moved = tissue.with_vertices(tissue.vertices + 0.4)
    table = table_of(rows_of(tissue, 0) + rows_of(moved, 1))
    table |= {axis: np.round(table[axis], digits) for axis in "xy"}
    box = np.round(np.asarray(tissue.boundary.lattice), digits)
    movie = movie_from_table(table, box=box)
    np.testing.assert_allclose(movie.frame(1).areas, tissue.areas, atol=10 * 10.0**-digits)
    assert movie.frame(1).n_vertices == tissue.n_vertices
    if digits > 3:
        assert movie.events == ()


def test_single_precision_is_enough():
    tissue = vx.initialise.periodic_voronoi(12, key=jax.random.key(2))
    rows = [row for k in range(2) for row in rows_of(tissue, k)]
    table = table_of(rows)
    table |= {axis: (table[axis] + 300).astype(np.float32) for axis in "xy"}
    movie = movie_from_table(table, box=tissue.boundary.lattice)
    np.testing.assert_allclose(movie.frame(1).areas, tissue.areas, atol=1e-3)


def test_cells_with_other_numbers_in_the_next_frame_are_followed():
    numbers = np.random.default_rng(0).permutation(20)
    kind = np.arange(20) % 3
    rows = rows_of(STRAIGHT, 0, type=kind) + rows_of(STRAIGHT, 1, numbers, type=kind)
    moved = STRAIGHT.with_vertices(STRAIGHT.vertices + 0.2)
    movie = movie_from_table(table_of(rows + rows_of(moved, 2, numbers, type=kind)))
    assert movie.events == ()
    assert [(repair.kind, repair.frame) for repair in movie.repairs] == [("renumbered", 1)]
    np.testing.assert_array_equal(movie.types, kind)
    np.testing.assert_allclose(movie.frame(2).centroids, moved.centroids, rtol=1e-9)


def test_cells_that_all_jump_are_not_renumbered():
    far = STRAIGHT.with_vertices(STRAIGHT.vertices + jnp.array([1.2, 0.3]))
    with pytest.raises(ValueError, match="must not jump"):
        movie_from_table(table_of(rows_of(STRAIGHT, 0) + rows_of(far, 1)))
    assert (
        movie_from_table(table_of(rows_of(STRAIGHT, 0) + rows_of(far, 1)), largest_jump=2.0).events
        == ()
    )


def test_areas_and_centroids_are_compared():
    areas, (x, y) = np.asarray(STRAIGHT.areas), np.asarray(STRAIGHT.centroids).T
    rows = lambda **columns: [row for k in range(2) for row in rows_of(STRAIGHT, k, **columns)]
    movie_from_table(table_of(rows(area=areas, centroid_x=x, centroid_y=y)))
    with pytest.raises(ValueError, match=r"Frame 0 .* cell 0 have the area 0.*the table has 0\.00"):
        movie_from_table(table_of(rows(area=areas / 100)))
    with pytest.raises(ValueError, match=r"cell 0 have the centroid .* leave out the columns"):
        movie_from_table(table_of(rows(centroid_x=x[::-1], centroid_y=y[::-1])))


def test_rounded_corners_need_a_tolerance():
    rows = rows_of(STRAIGHT, 0) + rows_of(STRAIGHT, 1)
    away = 1e-4 * np.sin(np.arange(len(rows)))
    table = table_of(rows)
    table = table | {"x": table["x"] + away, "y": table["y"] + away}
    with pytest.raises(ValueError, match=r"Frame 0 .* share corners .*Pass `tolerance=0\.0005`"):
        movie_from_table(table)
    movie = movie_from_table(table, tolerance=5e-4)
    assert movie.events == ()
    np.testing.assert_allclose(movie.frame(1).areas, STRAIGHT.areas, atol=1e-2)


def test_wrong_times_and_numbers_are_named():
    with pytest.raises(ValueError, match="`times` must"):
        Movie([STRAIGHT, STRAIGHT], [1, 0])
    with pytest.raises(ValueError, match="one entry per frame"):
        Movie([STRAIGHT, STRAIGHT], [0, 1, 2])
    with pytest.raises(ValueError, match="frame 1 has two cells 7"):
        Movie([STRAIGHT] * 2, [0, 1], cells=[np.arange(20), np.append(np.arange(19), 7)])
    with pytest.raises(ValueError, match=r"has none for \[19\]"):
        Movie([STRAIGHT] * 2, [0, 1], types=dict.fromkeys(range(19), 0))


def test_a_frame_that_does_not_exist_is_refused():
    movie = Movie([STRAIGHT] * 2, [0, 1])
    with pytest.raises(IndexError):
        movie.frame(2)


def test_types_of_a_movie_are_those_of_an_energy():
    movie = Movie([STRAIGHT] * 2, [0, 1], types={k: k % 2 for k in range(20)})
    assert movie.types is not None
    energy = vx.energies.by_type(jnp.eye(2), movie.types, outline=0.0)
    assert float(energy(movie.frame(0))) > 0
