"""Bands over replicates, boxes, colours and limits."""

import numpy as np
import pytest

from experiments._replicates import plot_band, plot_boxes, same_limits, series_colours
from vertax.plotting import SERIES, new_figure

pytestmark = pytest.mark.experiments

CURVES = np.array([[1.0, 100.0], [10.0, 10.0], [4.0, 1.0]])


@pytest.fixture
def ax():
    return new_figure()[1][0, 0]


def line_and_band(ax, curves, **options):
    plot_band(curves, ax, label="a", colour="red", **options)
    (line,), (band,) = ax.lines, ax.collections
    vertices = band.get_paths()[0].vertices
    at = lambda x: vertices[np.isclose(vertices[:, 0], x), 1]
    return np.asarray(line.get_ydata()), at


def test_band_of_mean_and_deviation(ax):
    line, band = line_and_band(ax, CURVES)
    np.testing.assert_allclose(line, [50.5, 10.0, 2.5])
    assert band(0).min() == pytest.approx(1.0)
    assert band(2).max() == pytest.approx(4.0)


def test_band_of_the_logarithm(ax):
    line, band = line_and_band(ax, CURVES, log=True)
    np.testing.assert_allclose(line, [10.0, 10.0, 2.0])
    np.testing.assert_allclose([band(0).min(), band(0).max()], [1, 100])
    assert ax.get_yscale() == "log"


def test_band_between_extremes(ax):
    line, band = line_and_band(ax, CURVES, extremes=True)
    np.testing.assert_allclose(line, [50.5, 10.0, 2.5])
    np.testing.assert_allclose([band(2).min(), band(2).max()], [1, 4])


def test_band_without_missing_and_nonpositive_values(ax):
    curves = np.array([[1.0, 4.0], [np.nan, 9.0], [0.0, 3.0], [0.0, np.inf]])
    line, _ = line_and_band(ax, curves, log=True)
    np.testing.assert_allclose(line, [2.0, 9.0, 3.0, np.nan])


def test_boxes_have_a_point_for_each_number(ax):
    groups = {"a": np.array([1.0, 2.0, np.nan, 4.0]), "b": np.array([[3.0], [5.0]])}
    plot_boxes(groups, ax, colours={"a": "red", "b": "blue"})
    points = {line.get_color(): line for line in ax.lines if line.get_marker() == "."}
    np.testing.assert_array_equal(points["red"].get_ydata(), [1, 2, 4])
    np.testing.assert_array_equal(points["blue"].get_xdata(), [2, 2])
    assert [label.get_text() for label in ax.get_xticklabels()] == ["a", "b"]
    ends = [np.asarray(line.get_ydata()) for line in ax.lines]
    medians = [y[0] for y in ends if len(y) == 2 and y[0] == y[1]]
    assert 2.0 in medians
    assert 4.0 in medians


def test_zeros_have_a_mark_on_a_logarithmic_axis(ax):
    groups = {"some": np.array([1e-3, 0.0]), "none": np.array([1.0, 2.0]), "all": np.zeros(1)}
    plot_boxes(groups, ax, colours=series_colours(groups), log=True)
    marks = [line for line in ax.lines if line.get_marker() == "v"]
    assert [int(np.ravel(line.get_xdata())[0]) for line in marks] == [1, 3]
    low, high = ax.get_ylim()
    assert 1e-5 < low < 1e-3
    assert 2 < high < 100


def test_colours_by_name():
    names = [f"method {k}" for k in range(9)]
    colours = series_colours(names)
    assert list(colours) == names
    assert len(set(colours.values())) == 7
    assert colours["method 0"] == colours["method 7"] == SERIES[0]


def test_same_limits_show_all():
    _, (axes,) = new_figure(1, 2)
    axes[0].set(xlim=(0, 1), ylim=(5, 6))
    axes[1].set(xlim=(-1, 0.5), ylim=(0, 1))
    same_limits(axes, x=False)
    assert [ax.get_ylim() for ax in axes] == [(0, 6), (0, 6)]
    assert axes[0].get_xlim() == (0, 1)
    same_limits(axes, y=False)
    assert [ax.get_xlim() for ax in axes] == [(-1, 1), (-1, 1)]
