"""Result files of Chaste."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster

import vertax as vx
from vertax.inference import Repair, movie_from_table
from vertax.io import read_table, write_chaste

# Three squares in a row, as Chaste writes them: a tab after the time, a space at the end.
NODES = "0 0 1 0 2 0 3 0 0 1 1 1 2 1 3 1 "
FILES = {
    "viznodes": f"0\t{NODES}\n0.5\t{NODES.replace('3 0', '3.1 0')}\n",
    "vizelements": "".join(f"{time}\t4 0 1 5 4 4 1 2 6 5 4 2 3 7 6 \n" for time in (0, 0.5)),
    "vizlabels": "".join(
        f"{time}\t 5 0 0.5 0.5 0 1 1.5 0.5 5 2 {x} {y}\n"
        for time, x, y in ((0, 2.5, 0.5), (0.5, 2.52540, 0.49206))
    ),
    "vizcelltypes": "0\t5 0 5 \n0.5\t5 0 5 \n",
    "vizboundarynodes": "0\t1 1 1 1 1 1 1 1 \n0.5\t1 1 1 1 1 1 1 1 \n",
}


@pytest.fixture
def folder(tmp_path):
    return lambda **changes: written(tmp_path, FILES | changes)


def written(folder, files):
    for name, text in files.items():
        if text is not None:
            (folder / f"results.{name}").write_text(text)
    return folder


def test_files_become_a_movie(folder):
    movie = movie_from_table(folder())
    np.testing.assert_array_equal(movie.times, [0, 0.5])
    np.testing.assert_array_equal(movie.types, [5, 0, 5])
    np.testing.assert_allclose(movie.frame(0).areas, 1, rtol=1e-12)
    np.testing.assert_allclose(movie.frame(1).areas, [1, 1, 1.05], rtol=1e-12)
    assert movie.events == ()
    assert movie.repairs == ()


def test_optional_files_may_be_missing(folder, tmp_path):
    (tmp_path / "results_from_time_0").mkdir()
    part = tmp_path / "results_from_time_0"
    written(part, {name: FILES[name] for name in ("viznodes", "vizelements")})
    assert set(read_table(tmp_path)) == {"frame", "time", "cell", "x", "y"}
    (tmp_path / "results_from_time_1").mkdir()
    written(tmp_path / "results_from_time_1", FILES)
    with pytest.raises(
        ValueError, match=r"of one run .* results_from_time_0, results_from_time_1\. Choose"
    ):
        read_table(tmp_path)


def test_a_line_without_an_end_is_left_out(folder):
    with (
        pytest.warns(UserWarning, match=r"last line of .*vizelements, number 3, has no end"),
        pytest.warns(UserWarning, match="first 2 times are read"),
    ):
        table = read_table(
            folder(
                viznodes=FILES["viznodes"] + f"1\t{NODES}\n",
                vizelements=FILES["vizelements"] + "1\t4 0 1 5 4 4 1 2 6",
            )
        )
    assert table["frame"].max() == 1


def test_clockwise_cells_are_turned(folder):
    turned = FILES["vizelements"].replace("4 1 2 6 5", "4 5 6 2 1")
    movie = movie_from_table(folder(vizelements=turned))
    assert movie.repairs == (Repair("clockwise", 0, (1,)), Repair("clockwise", 1, (1,)))
    np.testing.assert_allclose(movie.frame(0).areas, 1, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"viznodes": "0\t0 0 1\n"}, r"Line 1 of .*viznodes must hold two coordinates .* has 3"),
        ({"viznodes": "0\t0 0 x 1\n"}, r"Line 1 of .*viznodes must hold finite .* is '0\\t0 0 x"),
        ({"viznodes": f"0\t{NODES}\n0.5\tnan 0\n"}, r"Line 2 of .*viznodes must hold finite"),
        ({"viznodes": f"0\t{NODES}\n0\t{NODES}\n"}, r"Line 2 .* must be later .* time 0"),
        ({"vizelements": "0\t4 0 1 5\n"}, r"Line 1 .*vizelements .*cell 0 has 4 .* and 3 numbers"),
        ({"vizelements": "0\t2 0 1\n"}, r"three nodes or more .*cell 0 has 2 as this number"),
        ({"vizelements": "0\t4 0 1 5 9\n"}, r"nodes below 8, .* cell 0 has node 9\. Take the fi"),
        ({"vizelements": "0\t4 0 1 5 4.5\n"}, r"vizelements must hold integers"),
        ({"vizelements": "1\t4 0 1 5 4\n"}, r"must have the time 0 of results.viznodes, but has 1"),
        ({"vizelements": "0\t\n"}, r"must hold integers, the nodes of a cell at least"),
        ({"vizlabels": "0\t5 0 0.5 0.5 0 1\n"}, r"must have 4 numbers for each of 3 cells, but"),
        ({"vizcelltypes": "0\t5 0\n"}, r"celltypes must have 1 number for each of 3 cells"),
        ({"vizboundarynodes": "0\t1 1\n"}, r"1 number for each of 8 nodes, but has 2\. "),
        ({"viznodes": None}, r"must hold results.viznodes and .* but holds: results.vizbou"),
        ({"viznodes": ""}, r"the lines of at least one time"),
    ],
)
@pytest.mark.filterwarnings("ignore:Files of .* have different numbers of lines")
def test_wrong_files_are_named(folder, changes, message):
    with pytest.raises(ValueError, match=message):
        read_table(folder(**changes))


def test_labels_of_other_cells_are_named(folder):
    with pytest.raises(
        ValueError, match=r"Frame 0 .* cell 0 have the centroid 0\.5, 0\.5, and the table has 1\.5"
    ):
        movie_from_table(
            folder(
                vizlabels=FILES["vizlabels"].replace(
                    "0\t 5 0 0.5 0.5 0 1 1.5", "0\t 5 0 1.5 0.5 0 1 .5"
                )
            )
        )


@pytest.mark.thorough
def test_cells_are_followed_when_one_dies(tmp_path):
    """Chaste numbers cells by their places in a list, which shift if a cell is removed."""
    tissue = vx.initialise.free_voronoi(20, key=jax.random.key(4), lloyd_steps=20)
    tissue = tissue.with_angles(jnp.zeros(tissue.n_edges))
    inner = set(range(20)) - set(
        np.asarray(tissue.topology.edge_cells)[tissue.topology.on_outline, 0]
    )
    dead = min(inner)
    # It shrinks before it dies.
    inside = np.unique(np.flatnonzero(np.asarray(tissue.topology.cell) == dead) // 3)
    middle = tissue.centroids[dead]
    tissue = tissue.with_vertices(
        tissue.vertices.at[inside].set(middle + 0.1 * (tissue.vertices[inside] - middle))
    )
    less = vx.transitions.remove(tissue.with_capacity(20), dead).tissue.without_spare()
    for k, frame in enumerate((tissue, less, less)):
        one = vx.mesh.Trajectory()
        one.append(frame, time=float(k))
        write_chaste(tmp_path / str(k), one)
    names = ("results.viznodes", "results.vizelements")
    (tmp_path / "run").mkdir()
    for name in names:
        text = "".join((tmp_path / str(k) / name).read_text() for k in range(3))
        (tmp_path / "run" / name).write_text(text)
    movie = movie_from_table(tmp_path / "run")
    assert [event.kind for event in movie.events].count("death") == 1
    assert ("death", 1, (dead,)) in movie.events
    (repair,) = movie.repairs
    assert repair.kind == "renumbered"
    assert repair.cells == tuple(range(dead + 1, 20))


@pytest.mark.parametrize("kind", ["free", "periodic"])
def test_trajectories_are_written_and_read(tmp_path, kind):
    tissue = cluster(9, 2) if kind == "free" else vx.initialise.periodic_voronoi(12, key=0)
    trajectory = vx.mesh.Trajectory()
    for time in (0.0, 0.25):
        trajectory.append(tissue.with_vertices(tissue.vertices + time), time=time)
    types = np.arange(tissue.n_cells) % 3
    write_chaste(tmp_path / "run", trajectory, types=types, points_per_arc=100)
    box = tissue.boundary.lattice if kind == "periodic" else None
    movie = movie_from_table(tmp_path / "run", box=box)
    np.testing.assert_array_equal(movie.times, [0, 0.25])
    np.testing.assert_array_equal(movie.types, types)
    rtol = 1e-3 if kind == "free" else 1e-10
    np.testing.assert_allclose(movie.frame(1).areas, tissue.areas, rtol=rtol)
    assert movie.frame(1).n_vertices == tissue.n_vertices
    assert movie.events == ()
    assert movie.repairs == ()
    # The mesh of the last frame.
    node = np.loadtxt(tmp_path / "run" / "last.node", skiprows=1)
    first, *cells = (tmp_path / "run" / "last.cell").read_text().splitlines()
    assert first == f"{tissue.n_cells} 0"
    _, n, *corners = map(int, cells[0].split())
    assert len(corners) == n
    x, y = node[corners, 1:3].T
    if kind == "free":
        area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
        assert area == pytest.approx(float(tissue.areas[0]), rel=1e-3)
        assert node[:, 3].sum() > 0


@pytest.mark.thorough
def test_cells_keep_their_numbers_with_spare_slots(tmp_path):
    tissue = cluster(9, 2).with_capacity(12)
    less = vx.transitions.remove(tissue, 4).tissue
    trajectory = vx.mesh.Trajectory()
    trajectory.append(tissue)
    trajectory.append(less)
    write_chaste(tmp_path, trajectory)
    table = read_table(tmp_path)
    second = np.unique(table["cell"][table["frame"] == 1])
    np.testing.assert_array_equal(second, [0, 1, 2, 3, 5, 6, 7, 8])


def test_wrong_arguments_of_the_writer_are_named(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        write_chaste(tmp_path, vx.mesh.Trajectory())
    trajectory = vx.mesh.Trajectory()
    trajectory.append(cluster(5))
    with pytest.raises(ValueError, match="an integer for each of 5 cells"):
        write_chaste(tmp_path, trajectory, types=[0, 1])
