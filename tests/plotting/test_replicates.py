"""Bands over replicates, boxes, and the figures that hold them."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from vertax.plotting import (
    SERIES,
    house_style,
    new_figure,
    plot_band,
    plot_boxes,
    plot_tissue,
    same_limits,
    series_colours,
)

CURVES = np.array([[1.0, 100.0], [10.0, 10.0], [4.0, 1.0]])


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    plt.close("all")


def line_and_band(ax):
    (line,), (band,) = ax.lines, ax.collections
    vertices = band.get_paths()[0].vertices
    at = lambda x: vertices[np.isclose(vertices[:, 0], x), 1]
    return np.asarray(line.get_ydata()), at


class TestBand:
    def test_mean_and_deviation(self):
        line, band = line_and_band(plot_band(CURVES))
        np.testing.assert_allclose(line, [50.5, 10.0, 2.5])
        assert band(0).min() == pytest.approx(1.0)
        assert band(2).max() == pytest.approx(4.0)

    def test_of_the_logarithm(self):
        ax = plot_band(CURVES, log=True)
        line, band = line_and_band(ax)
        np.testing.assert_allclose(line, [10.0, 10.0, 2.0])
        np.testing.assert_allclose([band(0).min(), band(0).max()], [1, 100])
        assert ax.get_yscale() == "log"

    def test_range_at_given_places(self):
        line, band = line_and_band(plot_band(CURVES, [5.0, 6.0, 8.0], spread="range"))
        np.testing.assert_allclose(line, [50.5, 10.0, 2.5])
        np.testing.assert_allclose([band(8).min(), band(8).max()], [1, 4])

    def test_missing_and_nonpositive_values_are_omitted(self):
        curves = np.array([[1.0, 4.0], [np.nan, 9.0], [0.0, 3.0], [0.0, np.inf]])
        line, _ = line_and_band(plot_band(curves, log=True))
        np.testing.assert_allclose(line, [2.0, 9.0, 3.0, np.nan])

    def test_one_after_the_other_has_the_next_colour(self):
        ax = plot_band(CURVES, label="a")
        plot_band(CURVES, ax=ax, label="b")
        assert [line.get_color() for line in ax.lines] == list(SERIES[:2])
        assert ax.get_legend_handles_labels()[1] == ["a", "b"]

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match=r"`curves` must have shape .* has \(3,\)"):
            plot_band(np.ones(3))
        with pytest.raises(ValueError, match="`x` must have one entry for each of 3 rows"):
            plot_band(CURVES, np.arange(2))
        spread: Any = "error"
        with pytest.raises(ValueError, match='must be "deviation" or "range", but is \'error\''):
            plot_band(CURVES, spread=spread)
        assert plt.get_fignums() == []


class TestBoxes:
    def test_every_number_is_a_point_of_its_group(self):
        groups = {"a": np.array([1.0, 2.0, np.nan, 4.0]), "b": np.array([[3.0], [5.0]])}
        ax = plot_boxes(groups, colours={"a": "red", "b": "blue"})
        points = {line.get_color(): line for line in ax.lines if line.get_marker() == "."}
        np.testing.assert_array_equal(points["red"].get_ydata(), [1, 2, 4])
        np.testing.assert_array_equal(points["blue"].get_xdata(), [2, 2])
        assert [label.get_text() for label in ax.get_xticklabels()] == ["a", "b"]
        ends = [np.asarray(line.get_ydata()) for line in ax.lines]
        medians = [y[0] for y in ends if len(y) == 2 and y[0] == y[1]]
        assert 2.0 in medians
        assert 4.0 in medians

    def test_zeros_have_a_mark_on_a_logarithmic_axis(self):
        ax = plot_boxes({"some": [1e-3, 0.0], "none": [1.0, 2.0], "all": [0.0]}, log=True)
        marks = [line for line in ax.lines if line.get_marker() == "v"]
        assert [int(np.ravel(line.get_xdata())[0]) for line in marks] == [1, 3]
        low, high = ax.get_ylim()
        assert 1e-5 < low < 1e-3
        assert 2 < high < 100

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match="`groups` must have at least one group"):
            plot_boxes({})
        with pytest.raises(ValueError, match=r"`colours` must have .* none for \['b'\]"):
            plot_boxes({"a": [1.0], "b": [1.0]}, colours={"a": "red"})
        assert plt.get_fignums() == []


class TestFigure:
    def test_panels_have_the_sizes_asked_for(self):
        figure, axes = new_figure(2, 3, width=[3.0, 1.0, 2.0], height=2.0, room=0.5)
        assert axes.shape == (2, 3)
        np.testing.assert_allclose(figure.get_size_inches(), [6.5, 4.0])
        figure.canvas.draw()
        widths = [ax.get_window_extent().width for ax in axes[0]]
        assert widths[0] > 1.3 * widths[2] > 1.3 * widths[1]
        assert plt.get_fignums() == []

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"rows": 0}, "`rows` and `columns` must be positive"),
            ({"columns": 2, "width": [1.0]}, "`width` must be a positive number"),
            ({"height": -1.0}, "`height` must be a positive number"),
        ],
    )
    def test_wrong_arguments(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            new_figure(**arguments)

    def test_the_style_is_there_inside_only(self):
        before = dict(matplotlib.rcParams)

        @house_style()
        def size():
            return matplotlib.rcParams["font.size"]

        assert [size(), size()] == [8, 8]
        with house_style():
            assert matplotlib.rcParams["legend.frameon"] is False
        assert dict(matplotlib.rcParams) == before

    def test_colours_by_name(self):
        names = [f"method {k}" for k in range(9)]
        colours = series_colours(names)
        assert list(colours) == names
        assert len(set(colours.values())) == 7
        assert colours["method 0"] == colours["method 7"] == SERIES[0]

    def test_same_limits_show_all(self):
        _, (axes,) = new_figure(1, 2)
        axes[0].set(xlim=(0, 1), ylim=(5, 6))
        axes[1].set(xlim=(-1, 0.5), ylim=(0, 1))
        same_limits(axes, x=False)
        assert [ax.get_ylim() for ax in axes] == [(0, 6), (0, 6)]
        assert axes[0].get_xlim() == (0, 1)
        same_limits(axes, y=False)
        assert [ax.get_xlim() for ax in axes] == [(-1, 1), (-1, 1)]

    def test_a_figure_is_filled_once(self):
        import jax

        from vertax.initialise import periodic_voronoi

        tissue, figure = periodic_voronoi(4, key=jax.random.key(0)), Figure()
        assert plot_tissue(tissue, tissue.areas, figure=figure).figure is figure
        with pytest.raises(ValueError, match="`figure` must be empty"):
            plot_tissue(tissue, figure=figure)
