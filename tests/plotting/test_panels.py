"""Tissues and images side by side, scale bars, label images."""

from typing import Any

import jax
import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import rgb_to_hsv, to_rgb
from matplotlib.figure import Figure

import vertax as vx
from vertax.plotting import _style, label_colours, new_figure, plot_image, plot_tissues, scale_bar

IMAGE = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80)


@pytest.fixture(scope="module")
def tissues():
    small = vx.initialise.periodic_voronoi(6, key=jax.random.key(0), softening=0.0)
    large = vx.initialise.periodic_voronoi(15, key=jax.random.key(0), softening=0.0)
    return {"small": small, "large": large}


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    plt.close("all")


def one(ax, kind) -> Any:
    return max((c for c in ax.collections if isinstance(c, kind)), key=lambda c: c.get_zorder())


class TestTissues:
    def test_panels_share_one_scale_of_colours_and_of_lengths(self, tissues):
        axes = plot_tissues(tissues, lambda t: t.areas, label="area")
        assert [ax.get_title() for ax in axes] == ["small", "large"]
        areas = np.concatenate([np.asarray(t.areas) for t in tissues.values()])
        for ax, tissue in zip(axes, tissues.values(), strict=True):
            faces = one(ax, PolyCollection)
            assert faces.get_clim() == (areas.min(), areas.max())
            np.testing.assert_array_equal(faces.get_array(), tissue.areas)
        extents = [(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())) for ax in axes]
        np.testing.assert_allclose(extents[0], extents[1])
        (bar,) = axes[0].figure.axes[2:]
        assert bar.get_ylabel() == "area"
        axes[0].figure.canvas.draw()
        sizes = [ax.get_window_extent().size for ax in axes]
        np.testing.assert_allclose(sizes[0], sizes[1], rtol=0.01)

    def test_axes_show_all_cells(self, tissues):
        for ax, tissue in zip(plot_tissues(tissues), tissues.values(), strict=True):
            points = vx.plotting.cell_polygons(tissue)[0].reshape(-1, 2)
            low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
            assert np.all(low < points.min(axis=0))
            assert np.all(points.max(axis=0) < high)

    def test_bars_point_beyond_common_limits(self, tissues):
        tension = [np.arange(t.n_edges) for t in tissues.values()]
        axes = plot_tissues(tissues, edges=tension, edge_vmax=30, edge_label="tension")
        (bar,) = axes[0].figure.axes[2:]
        assert [text.get_text() for text in bar.texts] == ["44"]
        for ax in axes:
            assert one(ax, LineCollection).get_clim() == (0, 30)

    def test_which_bars(self, tissues):
        values = (lambda t: t.areas, lambda t: t.edge_lengths)
        for colorbar, number in ((True, 2), (False, 0), ("edges", 1), ("cells", 1)):
            figure = Figure()
            options: Any = {"colorbar": colorbar, "label": "cells", "edge_label": "edges"}
            plot_tissues(tissues, *values, figure=figure, **options)
            bars = [ax.get_ylabel() for ax in figure.axes[2:]]
            assert len(bars) == number
            assert colorbar in (True, False) or bars == [colorbar]

    def test_over_an_image_and_the_image_alone(self, tissues):
        panels = {"image": None, "mesh": tissues["large"], "areas": tissues["large"]}
        areas = np.asarray(tissues["large"].areas)
        axes = plot_tissues(panels, [None, None, areas], image=IMAGE, pixel_size=0.05)
        assert [len(ax.images) for ax in axes] == [1, 1, 1]
        assert {(ax.get_xlim(), ax.get_ylim()) for ax in axes} == {((0, 4.0), (3.0, 0))}
        assert len(axes[0].collections) == 0
        assert len(one(axes[1], PolyCollection).get_facecolor()) == 0
        assert one(axes[2], PolyCollection).get_array().max() == areas.max()

    def test_in_given_axes_without_pyplot(self, tissues):
        _, (axes,) = new_figure(1, 3)
        assert plot_tissues(tissues, axes=axes[:2]) == list(axes[:2])
        assert len(axes[2].collections) == 0
        assert plt.get_fignums() == []

    @pytest.mark.parametrize(
        ("panels", "arguments", "message"),
        [
            ([], {}, "`tissues` must have at least one panel"),
            (["small", None], {}, "`tissues` must have a tissue in each panel"),
            (["small", "large"], {"cells": [np.zeros(6)]}, "`cells` must have values for each of"),
            (["small"], {"cells": [np.zeros(7)]}, r"`cells` must have shape \(6,\)"),
            (["small"], {"edges": [np.zeros(7)]}, r"`edges` must have shape \(18,\)"),
            (["small"], {"mask": np.ones(7, bool)}, r"`mask` must have shape \(6,\)"),
            (["small"], {"colorbar": "edge"}, "`colorbar` must be one of True, False,"),
            (["small"], {"axes": []}, "`axes` must have one entry for each of the 1 panels"),
            (["small"], {"image": np.zeros(4)}, "`image` must have shape"),
        ],
    )
    def test_wrong_arguments_are_named_and_leave_no_figure(
        self, tissues, panels, arguments, message
    ):
        shown = {str(name): tissues.get(name) for name in panels}
        with pytest.raises(ValueError, match=message):
            plot_tissues(shown, **arguments)
        assert plt.get_fignums() == []


class TestImage:
    def test_the_first_row_is_at_the_top(self):
        ax = plot_image(IMAGE, pixel_size=0.5)
        assert ax.get_xlim() == (0, 40)
        assert ax.get_ylim() == (30, 0)
        (image,) = ax.images
        assert list(image.get_extent()) == [0, 40, 30, 0]
        np.testing.assert_array_equal(image.get_array(), IMAGE)

    def test_pixels_have_a_height_and_a_width(self):
        ax = plot_image(IMAGE, pixel_size=(1.0, 0.5))
        assert ax.get_xlim() == (0, 40)
        assert ax.get_ylim() == (60, 0)

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match=r"`image` must have shape .* has \(4,\)"):
            plot_image(np.zeros(4))
        with pytest.raises(ValueError, match="`pixel_size` must be positive"):
            plot_image(IMAGE, pixel_size=-1)
        assert plt.get_fignums() == []


class TestScaleBar:
    def parts(self, ax):
        (bar,) = ax.artists
        return bar.size_bar.get_children()[0], bar.txt_label.get_children()[0]

    def test_its_length_is_round_and_to_scale(self):
        ax = plot_image(IMAGE, pixel_size=0.5)  # 40 units, 80 pixels wide
        scale_bar(ax, "pixels", unit_length=0.5)
        line, text = self.parts(ax)
        assert text.get_text() == "20 pixels"
        assert line.get_width() == pytest.approx(10.0)

    @pytest.mark.parametrize("width", [1e-3, 0.9, 1.1, 7.0, 42.0, 1e6])
    def test_it_is_a_seventh_to_a_quarter_of_the_width(self, width):
        _, ((ax,),) = new_figure()
        ax.set_xlim(0, width)
        scale_bar(ax, "µm")
        length = self.parts(ax)[0].get_width()
        assert width / 10 < length <= width / 4 * (1 + 1e-9)
        digits = f"{length:.6e}".split("e")[0]
        assert digits in ("1.000000", "2.000000", "5.000000")

    def test_below_a_tissue_it_changes_no_limits(self, tissues):
        ax = vx.plot_tissue(tissues["large"])
        before = ax.get_xlim(), ax.get_ylim()
        scale_bar(ax, length=2)
        assert (ax.get_xlim(), ax.get_ylim()) == before
        ax.figure.canvas.draw()
        bottom = ax.get_window_extent().y0
        bar, text = (part.get_window_extent() for part in self.parts(ax))
        assert bar.y1 < bottom
        assert text.y1 < bar.y0 + 1
        assert bar.width == pytest.approx(2 * ax.get_window_extent().width / np.ptp(before[0]))

    def test_in_an_image_with_y_upwards_it_is_still_in_the_lower_right(self):
        ax = plot_image(IMAGE)
        ax.invert_yaxis()
        scale_bar(ax, "pixels")
        ax.figure.canvas.draw()
        frame, bar = ax.get_window_extent(), self.parts(ax)[0].get_window_extent()
        assert frame.y0 < bar.y0 < frame.y0 + 0.1 * frame.height
        assert frame.x0 + 0.6 * frame.width < bar.x0
        assert bar.x1 < frame.x1

    def test_wrong_arguments(self):
        _, ((ax,),) = new_figure()
        with pytest.raises(ValueError, match="`length` must be positive"):
            scale_bar(ax, length=0)
        with pytest.raises(ValueError, match="`unit_length` must be positive"):
            scale_bar(ax, unit_length=np.nan)


class TestLabels:
    def test_each_label_has_one_dark_colour_of_its_own(self):
        labels = np.array([[0, 3, 3], [7, 7, 60000], [0, 1, 2]], np.uint16)
        colours = label_colours(labels)
        assert colours.shape == (3, 3, 3)
        assert np.all(colours[labels == 0] == 0)
        np.testing.assert_array_equal(colours[0, 1], colours[0, 2])
        different = {tuple(c) for c in colours.reshape(-1, 3)}
        assert len(different) == len(np.unique(labels))
        values = rgb_to_hsv(colours[labels > 0])[:, 2]
        assert values.min() > 0.3
        assert values.max() < 0.5

    def test_a_mesh_shows_on_every_label(self):
        # Contrast of relative luminances, as recommended for text on web pages.
        labels = np.arange(400).reshape(20, 20)
        linear = lambda c: np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        luminance = lambda c: linear(c) @ np.array([0.2126, 0.7152, 0.0722])
        mesh = luminance(np.array(to_rgb(_style.HIGHLIGHT)))
        assert np.min((mesh + 0.05) / (luminance(label_colours(labels)) + 0.05)) > 2.5

    def test_labels_that_follow_each_other_differ(self):
        colours = label_colours(np.arange(1, 400).reshape(1, -1))[0]
        assert np.abs(np.diff(colours, axis=0)).max(axis=1).min() > 0.05

    def test_wrong_arguments(self):
        for labels in (np.zeros((2, 2)), np.zeros((2, 2, 3), int)):
            with pytest.raises(ValueError, match="`labels` must hold whole numbers"):
                label_colours(labels)
