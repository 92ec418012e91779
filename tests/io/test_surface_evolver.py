"""Foams of Surface Evolver."""

import re
from pathlib import Path

import numpy as np
import pytest

import vertax as vx

DATA = Path(__file__).parents[3] / "shared" / "data" / "surface_evolver"
# Two cells side by side, their interface of two pieces; the right one is listed clockwise, the left one is
# turned over by its body.
DOUBLET = """// a comment
SPACE_DIMENSION 2
STRING
TOTAL_TIME 12.5
vertices        /*  coordinates  */
 1   0  -1
 2   0.1  0.0
 5   0   1
 6   1.5   0
 7  -1.5   0
edges
 1   1 2  density 0.5
 2   2 5  density 0.5
 3   1 6  density 2
 4   6 5  density 3 original 3
 5   5 7
 6   7 1  color red
faces    /* edge loop */
 1   1 2 -4 \\
     -3 /*area 1.4*/
 2   1 2 5 6
bodies  /* facets */
 1   1  volume 1.5 lagrange_multiplier 0.25 centerofmass
 2  -2
read
show_all_edges off
"""


@pytest.fixture
def doublet(tmp_path):
    path = tmp_path / "doublet.fe"
    path.write_text(DOUBLET, encoding="utf-8")
    return path


def test_a_doublet(doublet):
    foam = vx.io.read_surface_evolver(doublet)
    tissue = foam.tissue
    assert (tissue.n_cells, tissue.n_vertices, tissue.n_edges) == (2, 2, 3)
    assert not tissue.overlaps.any
    np.testing.assert_allclose(tissue.areas, [1.4, 1.6], rtol=1e-12)
    np.testing.assert_allclose(foam.target_areas, [1.5, 1.6], rtol=1e-12)
    np.testing.assert_allclose(foam.pressures, [0.25, 0.0])
    assert foam.time == 12.5
    np.testing.assert_array_equal(foam.bodies, [1, 2])
    inner = int(np.argmin(np.asarray(tissue.topology.on_outline)))
    assert foam.tensions[inner] == 0.5
    assert len(foam.chains[inner]) == 3
    # The outline of the first cell has pieces of tension 2 and 3, of the same length.
    right = next(e for e, chain in enumerate(foam.chains) if chain[:, 0].max() > 1)
    np.testing.assert_allclose(foam.tensions[right], 2.5)
    np.testing.assert_allclose(foam.tension_spreads[right], 1.0)
    left = 3 - right - inner
    np.testing.assert_allclose([foam.tensions[left], foam.tension_spreads[left]], [1.0, 0.0])
    ends = np.asarray(tissue.topology.edge_vertices)
    for chain, (first, last) in zip(foam.chains, ends, strict=True):
        np.testing.assert_array_equal(chain[[0, -1]], tissue.vertices[np.array([first, last])])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t[: t.index("bodies")], "no section `bodies`"),
        (lambda t: t.replace("DIMENSION 2", "DIMENSION 4"), "4 dimensions"),
        (lambda t: t.replace(" 6   7 1  color red\n", ""), "element 6 is used but missing"),
        (lambda t: t.replace("1 2 5 6", "1 2 5 -6"), "not a closed loop"),
        (lambda t: t.replace(" 5   0   1", " 5   0"), "a line cannot be read"),
        (lambda t: "nothing", "no section `vertices`"),
        (lambda t: t.replace(" 1   1  volume", " 0   1  volume"), "a body has the number 0"),
    ],
)
def test_a_broken_file_is_refused(doublet, change, message):
    doublet.write_text(change(DOUBLET), encoding="utf-8")
    with pytest.raises(ValueError, match=f"doublet.fe is not a foam.*{message}"):
        vx.io.read_surface_evolver(doublet)


def test_cells_that_touch_in_a_point_are_refused(doublet):
    text = DOUBLET.replace("edges\n", " 8 0.5 2\n 9 -0.5 2\nedges\n 7 5 8\n 8 8 9\n 9 9 5\n")
    text = text.replace("bodies", " 3 7 8 9\nbodies").replace("read", " 3 3\nread", 1)
    doublet.write_text(text.replace("/* facets */ 3 3\nread", ""), encoding="utf-8")
    with pytest.raises(ValueError, match=r"bodies must .* touch in the point \[0.0, 1.0\] only"):
        vx.io.read_surface_evolver(doublet)


@pytest.fixture
def fan(tmp_path):
    """Three triangles at the origin, which is on the outline: four edges meet there."""
    path = tmp_path / "fan.fe"
    path.write_text(
        "vertices\n1 0 0\n2 2 0\n3 1 2\n4 -1 2\n5 -2 0\n"
        "edges\n1 1 2\n2 2 3\n3 3 1 density 2\n4 3 4\n5 4 1 density 3\n6 4 5\n7 5 1\n"
        "faces\n1 1 2 3\n2 -3 4 5\n3 -5 6 7\nbodies\n1 1\n2 2\n3 3\nread\n",
        encoding="utf-8",
    )
    return path


def test_a_point_where_four_edges_meet_becomes_two_vertices(fan):
    foam = vx.io.read_surface_evolver(fan)
    lengths = np.asarray(foam.tissue.edge_lengths)
    assert np.sum(np.all(np.asarray(foam.tissue.vertices) == 0, axis=1)) == 2
    link = int(np.argmin(lengths))
    assert not foam.tissue.topology.on_outline[link]
    # The mean of the tensions of the four edges that meet there.
    np.testing.assert_allclose(foam.tensions[link], (1 + 2 + 3 + 1) / 4)
    np.testing.assert_array_equal(foam.chains[link], np.zeros((2, 2)))
    np.testing.assert_allclose(foam.tissue.areas, 2, rtol=1e-9)


def test_binary_files_raise(tmp_path):
    path = tmp_path / "image.dmp"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ValueError, match="not text"):
        vx.io.read_surface_evolver(path)


@pytest.mark.skipif(not DATA.exists(), reason="the folder shared/data is not there")
def test_chains_that_cross_near_a_junction_are_read(tmp_path):
    text = (DATA / "movie_0.dmp").read_text(encoding="utf-8")
    original = vx.io.read_surface_evolver(DATA / "movie_0.dmp")
    ends = np.asarray(original.tissue.topology.edge_vertices)
    # Move the point next to a junction by 20 degrees beyond the other chain that leaves from there.
    vertex = int(ends[int(np.argmin(np.asarray(original.tissue.topology.on_outline))), 0])
    chains = [
        chain if start == vertex else chain[::-1]
        for chain, (start, end) in zip(original.chains, ends, strict=True)
        if vertex in (start, end)
    ]
    junction, first, other = chains[0][0], chains[0][1], chains[1][1]
    axis, step = other - junction, first - junction
    turn = -np.deg2rad(20) * np.sign(axis[0] * step[1] - axis[1] * step[0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = junction + 0.2 * rotation @ axis
    old = next(
        line
        for line in text.splitlines()
        if re.match(r"\s*\d+\s+\S+\s+\S+", line)
        and np.allclose(_numbers(line)[1:3], first, rtol=0, atol=1e-12)
    )
    number = old.split()[0]
    path = tmp_path / "crossed.dmp"
    path.write_text(
        text.replace(old, f"{number} {moved[0]:.17g} {moved[1]:.17g}", 1), encoding="utf-8"
    )
    foam = vx.io.read_surface_evolver(path)
    np.testing.assert_array_equal(
        foam.tissue.topology.edge_cells, original.tissue.topology.edge_cells
    )
    np.testing.assert_array_equal(foam.tissue.topology.edge_vertices, ends)


def _numbers(line: str) -> list[float]:
    words = line.split()[:3]
    try:
        return [float(word) for word in words]
    except ValueError:
        return [np.nan] * 3


@pytest.mark.skipif(not DATA.exists(), reason="the folder shared/data is not there")
@pytest.mark.parametrize("name", ["movie_0", "movie_3", "cells100"])
def test_foams_with_known_areas(name):
    path = DATA / f"{name}.dmp"
    foam = vx.io.read_surface_evolver(path)
    actual = re.findall(r"/\*actual: (\S+)\*/", path.read_text())
    np.testing.assert_allclose(foam.tissue.areas, np.array(actual, float), rtol=1e-9)
    outline = np.asarray(foam.tissue.topology.on_outline)
    assert (np.asarray(foam.tension_spreads)[~outline] == 0).all()
    assert not foam.tissue.overlaps.any
    assert (np.asarray(foam.pressures) > 0).all()


@pytest.mark.skipif(not DATA.exists(), reason="the folder shared/data is not there")
@pytest.mark.parametrize("volume", [True, False])
def test_pressures_of_bodies_listed_clockwise_have_the_sign_of_the_others(tmp_path, volume):
    path = DATA / "movie_3.dmp"
    text = path.read_text(encoding="utf-8")
    original = vx.io.read_surface_evolver(path)
    start = text.index("bodies  /*")
    stop = text.index("read", start)
    turn = lambda row: re.sub(
        r"^( *\d+ +)(-?\d+)( .*volume )(\S+)(.*multiplier )",
        lambda m: f"{m[1]}{-int(m[2])}{m[3]}-{m[4]}{m[5]}-",
        row,
    )
    rows = text[start:stop].splitlines()
    rows = [turn(row) if k % 2 else row for k, row in enumerate(rows)]
    if not volume:
        rows = [re.sub(r"volume \S+", "", row) for row in rows]
    turned = tmp_path / "turned.dmp"
    turned.write_text(text[:start] + "\n".join(rows) + "\n" + text[stop:], encoding="utf-8")
    foam = vx.io.read_surface_evolver(turned)
    np.testing.assert_array_equal(foam.pressures, original.pressures)
    np.testing.assert_allclose(foam.target_areas, original.target_areas, rtol=1e-4)
