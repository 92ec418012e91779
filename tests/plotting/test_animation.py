"""Animations and marked edges."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import cluster
from helpers import random_tissue
from matplotlib.animation import FFMpegWriter
from matplotlib.figure import Figure
from PIL import Image

import vertax as vx
from vertax.plotting import _animation, _style, flipped_edges
from vertax.plotting._animation import _marks, _placed
from vertax.plotting._colours import add_bar
from vertax.plotting._tissue import _repeated
from vertax.transitions._euler_operators import flip_edges


def flipped(tissue, *edges):
    flip = jnp.isin(jnp.arange(tissue.n_edges), jnp.asarray(edges))
    return tissue.with_topology(flip_edges(tissue.topology, flip))


@pytest.fixture(scope="module")
def way():
    """A tissue of which an edge flips after the first frame."""
    tissue = random_tissue(8, 2)
    after = flipped(tissue, 3)
    return [tissue, after, after, after.with_vertices(after.vertices + 0.02)]


def frames_of(path):
    with Image.open(path) as file:
        frames, times = [], []
        for k in range(getattr(file, "n_frames", 1)):
            file.seek(k)
            frames.append(np.asarray(file.convert("RGB")))
            times.append(file.info["duration"])
    return frames, times


def has(picture, colour):
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return bool((np.abs(picture.astype(int) - wanted).max(axis=-1) < 12).any())


def test_flipped_edges_are_those_of_transitions(way):
    assert np.flatnonzero(flipped_edges(way[0], way[1])).tolist() == [3]
    assert not flipped_edges(way[1], way[2]).any()
    assert not flipped_edges(way[0], flipped(flipped(way[0], 3), 3)).any()
    with pytest.raises(ValueError, match="another state of the same tissue, but has 5 cells"):
        flipped_edges(way[0], random_tissue(5))


def test_marks_stay_for_some_frames(way):
    assert [m.sum() for m in _marks(way, 2)] == [0, 1, 1, 0]
    assert [m.sum() for m in _marks(way, 0)] == [0, 0, 0, 0]


def test_a_gif_has_a_picture_for_each_frame_and_marks_transitions(way, tmp_path):
    path = tmp_path / "way.gif"
    values = np.linspace(0, 1, 4 * 8).reshape(4, 8)
    vx.animate(
        way, path, values, fps=20, last_frame_seconds=1, mark_t1=2, captions=list("abcd"), dpi=60
    )
    frames, times = frames_of(path)
    assert [has(frame, _style.MARK) for frame in frames] == [False, True, True, False]
    # Values change between all frames, so no two frames are merged.
    assert times == [50, 50, 50, 1050]
    assert [file.name for file in tmp_path.iterdir()] == ["way.gif"]
    corners = {tuple(frame[0, 0]) for frame in frames}
    assert corners == {(255, 255, 255)}


def test_frames_of_a_gif_are_not_shorter_than_viewers_show(way, tmp_path):
    values = np.linspace(0, 1, 4 * 8).reshape(4, 8)
    vx.animate(way, tmp_path / "fast.gif", values, fps=200, last_frame_seconds=0.1, dpi=60)
    assert frames_of(tmp_path / "fast.gif")[1] == [20, 20, 20, 120]


@pytest.mark.thorough
def test_colour_bar_shows_values_beyond_its_limits(way, tmp_path, monkeypatch):
    bars = []
    keep = lambda *args, **options: bars.append(add_bar(*args, **options))
    monkeypatch.setattr(_animation, "add_bar", keep)
    values = np.linspace(0, 1, 4 * 8).reshape(4, 8)
    limits: dict[str, Any]
    for limits in ({}, {"vmax": 0.5}, {"vmin": 0.1, "vmax": 0.5}):
        vx.animate(way, tmp_path / "way.gif", values, dpi=60, **limits)
    assert [bar.extend for bar in bars] == ["neither", "max", "both"]


def test_values_may_be_a_function_and_clusters_have_arcs(tmp_path):
    tissue = cluster(5)
    way = vx.mesh.Trajectory()
    for scale in (1.0, 1.1):
        way.append(tissue.with_vertices(scale * tissue.vertices))
    vx.animate(way, tmp_path / "free.gif", lambda t: t.areas, dpi=60)
    vx.animate(way, tmp_path / "plain.gif", dpi=60)
    (small, large), _ = frames_of(tmp_path / "plain.gif")
    drawn = lambda picture: (picture < 128).all(axis=-1).any(axis=0).sum()
    assert drawn(small) < drawn(large)


def test_no_cell_jumps_across_a_periodic_box():
    tissue = random_tissue(8, 2)
    drift = jnp.array([0.3, -0.2])
    way = [tissue.with_vertices(tissue.vertices + k * drift) for k in range(12)]
    centroids = np.stack([drawing.centroids for drawing in _placed(way)])
    np.testing.assert_allclose(
        np.diff(centroids, axis=0), np.broadcast_to(drift, (11, 8, 2)), atol=1e-9
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trajectory": []}, "`trajectory` must have at least one frame"),
        (
            {"trajectory": [random_tissue(4), random_tissue(5)]},
            "`trajectory` must hold single tissues",
        ),
        ({"path": "way.avi"}, r"`path` must end in \.gif or \.mp4, but is 'way\.avi'"),
        ({"cells": np.zeros((4, 7))}, r"`cells` must give .* shape \(4, 8\), but gives \(4, 7\)"),
        ({"captions": ["a"]}, "`captions` must have one text for each of the 4 frames, but has 1"),
        ({"fps": 0.0}, "`fps` must be positive"),
        ({"mark_t1": -1}, "`mark_t1` must be at least 0"),
    ],
)
def test_invalid_arguments_raise(way, tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        vx.animate(**({"trajectory": way, "path": "way.gif"} | changes))
    assert list(tmp_path.iterdir()) == []


def plain_figure(width, colour):
    return Figure(figsize=(width, 1.0), facecolor=colour)


def test_figures_become_an_animation_with_white_margins(tmp_path):
    path = tmp_path / "figures.gif"
    drawn = []

    def figures():
        for width, colour in ((1.0, "#cc0000"), (2.0, "#0000cc")):
            drawn.append(colour)
            yield plain_figure(width, colour)

    vx.plotting.animate_figures(figures(), path, fps=5, last_frame_seconds=1.0, dpi=50)
    assert drawn == ["#cc0000", "#0000cc"]
    pictures, times = frames_of(path)
    assert [p.shape for p in pictures] == [(50, 100, 3)] * 2
    assert has(pictures[0][:, :50], "#cc0000")
    assert np.all(pictures[0][:, 52:] > 250)
    assert has(pictures[1][:, 60:], "#0000cc")
    assert times == [200, 1200]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0}, "`fps` must be positive"),
        ({"dpi": -1}, "`dpi` must be positive"),
        ({"last_frame_seconds": -1}, "`last_frame_seconds` must be at least 0"),
        ({"figures": []}, "`figures` must have at least one figure"),
        ({"path": "a.png"}, "`path` must end in .gif or .mp4"),
    ],
)
def test_wrong_arguments_of_an_animation_of_figures_raise(tmp_path, options, message):
    values = {"figures": [plain_figure(1.0, "r")], "path": "a.gif"} | options
    with pytest.raises(ValueError, match=message):
        vx.plotting.animate_figures(values.pop("figures"), tmp_path / values.pop("path"), **values)
    assert not any(tmp_path.iterdir())


def test_a_film_needs_ffmpeg(way, tmp_path, monkeypatch):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    with pytest.raises(RuntimeError, match=r"Install ffmpeg, or set .* or write a GIF"):
        vx.animate(way, tmp_path / "way.mp4")


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="there is no ffmpeg")
def test_a_film_is_written(way, tmp_path):
    vx.animate(way, tmp_path / "way.mp4", dpi=60)
    assert b"ftyp" in (tmp_path / "way.mp4").read_bytes()[:32]


def test_an_interrupt_leaves_the_old_file(way, tmp_path):
    path = tmp_path / "way.gif"
    path.write_bytes(b"old")

    def interrupt(tissue):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        vx.animate(way, path, interrupt)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["way.gif"]


def test_marked_edges_are_drawn_once_at_each_of_their_cells(way):
    ax = vx.plot_tissue(way[1], highlight=flipped_edges(way[0], way[1]))
    marks = [c for c in ax.collections if c.get_zorder() == 2.5]
    assert [len(c.get_segments()) in (1, 2) for c in marks] == [True, True]
    with pytest.raises(ValueError, match=r"`highlight` must have shape \(24,\)"):
        vx.plot_tissue(way[1], highlight=jnp.zeros(3, bool))


def test_a_periodic_tissue_covers_an_image(way):
    tissue = way[0]
    side = float(np.sqrt(8))
    ax = vx.plot_tissue(tissue, image=np.zeros((32, 32)), pixel_size=side / 32)
    (lines,) = (c for c in ax.collections if c.get_zorder() == 2)
    visible = np.concatenate(lines.get_segments())
    # Every vertex is drawn at its position in the image.
    for vertex in np.asarray(tissue.vertices) % side:
        assert np.linalg.norm(visible - vertex, axis=1).min() < 1e-6


def test_repeated_shapes_are_all_that_can_be_seen():
    lattice = np.array([[2.0, 0.0], [0.7, 1.5]])
    point = np.array([[[0.3, 0.2]], [[1.5, 1.1]]])
    low, high = np.array([-3.0, -4.0]), np.array([5.0, 3.0])
    shapes, numbers = _repeated(point, np.arange(2), lattice, low, high)
    steps = np.stack(np.meshgrid(np.arange(-20, 20), np.arange(-20, 20)), -1).reshape(-1, 2)
    everywhere = point[:, 0] + (steps @ lattice)[:, None]
    inside = np.all((everywhere >= low) & (everywhere <= high), axis=-1)
    assert len(shapes) == inside.sum()
    np.testing.assert_array_equal(np.bincount(numbers), inside.sum(axis=0))
    nothing, _ = _repeated(point[:0], np.arange(0), lattice, low, high)
    assert len(nothing) == 0
