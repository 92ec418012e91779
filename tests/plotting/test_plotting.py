"""Contents of figures."""

import dataclasses
from typing import Any

import jax
import matplotlib
import numpy as np
import pytest
from free_helpers import cluster
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

import vertax as vx
from vertax.fitting import History
from vertax.plotting import cell_polygons, plot_history, plot_recovery, plot_tissue

TISSUES = {
    "square": lambda: vx.initialise.periodic_voronoi(15, key=jax.random.key(0), softening=0.0),
    "sheared": lambda: vx.initialise.periodic_voronoi(
        9, key=jax.random.key(1), lattice=np.array([[3.0, 0.2], [-1.6, 3.0]]), softening=0.0
    ),
    "one cell": lambda: vx.initialise.periodic_voronoi(1, key=jax.random.key(2), softening=0.0),
    "hexagons": lambda: vx.initialise.hexagonal(3, 4, softening=0.0),
}


@pytest.fixture(scope="module", params=TISSUES)
def any_tissue(request):
    return TISSUES[request.param]()


@pytest.fixture(scope="module")
def tissue():
    return TISSUES["square"]()


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    plt.close("all")


def faces_of(ax) -> Any:
    (faces,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    return faces


def lines_of(ax) -> Any:
    """The lines of the edges; a casing, if any, lies below them."""
    return max(
        (c for c in ax.collections if isinstance(c, LineCollection)), key=lambda c: c.get_zorder()
    )


def shoelace(polygon):
    p, q = polygon, np.roll(polygon, -1, axis=0)
    return 0.5 * np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])


class TestPolygons:
    def test_polygons_have_the_areas_of_their_cells(self, any_tissue):
        polygons, sides = cell_polygons(any_tissue)
        np.testing.assert_array_equal(sides, any_tissue.neighbour_counts)
        areas = [shoelace(p[:n]) for p, n in zip(polygons, sides, strict=True)]
        np.testing.assert_allclose(areas, any_tissue.areas, rtol=1e-12)
        # Rows are padded with the first corner, which does not change a closed line.
        np.testing.assert_allclose([shoelace(p) for p in polygons], areas, rtol=1e-12)

    def test_cells_lie_in_the_home_box(self, any_tissue):
        far = any_tissue.with_configuration(any_tissue.vertices + np.array([17.0, -23.0]))
        lattice = np.asarray(any_tissue.boundary.lattice)
        polygons, sides = cell_polygons(far)
        shift = polygons[:, 0] - np.asarray(cell_polygons(any_tissue)[0])[:, 0]
        assert np.abs(shift).max() < 2 * np.abs(lattice).sum()
        centres = np.array([centroid(p[:n]) for p, n in zip(polygons, sides, strict=True)])
        fractions = centres @ np.linalg.inv(lattice)
        assert fractions.min() > -1e-5
        assert fractions.max() < 1 + 1e-9

    def test_cells_of_a_regular_lattice_stay_side_by_side_with_rounding(self):
        # Centroids on the sides of the box: rounding must not move them to the other side.
        tissue = vx.initialise.hexagonal(4, 4)
        start = np.asarray(tissue.vertices - tissue.centroids[0])
        places = set()
        for noise in (-1e-12, 0.0, 1e-12):
            moved = tissue.with_configuration(jax.numpy.asarray(start + noise))
            places.add(tuple(np.round(cell_polygons(moved)[0].ravel(), 6) + 0.0))
        assert len(places) == 1

    @pytest.mark.thorough
    def test_number_of_points_per_arc(self):
        tissue = cluster(5)
        off = []
        for points in (1, 8, 64):
            polygons, sides = cell_polygons(tissue, points_per_arc=points)
            np.testing.assert_array_equal(sides, points * np.asarray(tissue.neighbour_counts))
            areas = [shoelace(p[:n]) for p, n in zip(polygons, sides, strict=True)]
            off.append(np.abs(areas - np.asarray(tissue.areas)).max())
        # The missing area of an inscribed polygon decreases with the square of the number of pieces.
        assert off[0] > 10 * off[1]
        assert off[1] == pytest.approx(64 * off[2], rel=0.1)
        with pytest.raises(ValueError, match="`points_per_arc` must be at least 1"):
            cell_polygons(tissue, points_per_arc=0)


def centroid(polygon):
    # Relative to a corner: the formula loses digits far from the origin.
    p = polygon - polygon[0]
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return polygon[0] + ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


class TestTissue:
    def test_one_polygon_a_cell_of_its_area(self, any_tissue):
        faces = faces_of(plot_tissue(any_tissue))
        areas = [shoelace(path.vertices[:-1]) for path in faces.get_paths()]
        np.testing.assert_allclose(areas, any_tissue.areas, rtol=1e-12)

    def test_every_side_of_every_cell_is_drawn_once(self, any_tissue):
        polygons, sides = cell_polygons(any_tissue)
        key = lambda a, b: tuple(sorted(tuple(np.round(x, 6) + 0.0) for x in (a, b)))
        expected = {
            key(p[k], p[(k + 1) % n])
            for p, n in zip(polygons, sides, strict=True)
            for k in range(n)
        }
        drawn = [key(*segment) for segment in lines_of(plot_tissue(any_tissue)).get_segments()]
        assert set(drawn) == expected
        assert len(drawn) == len(expected)
        assert len(drawn) > any_tissue.n_edges  # edges across the boundary are drawn twice

    def test_values_colour_their_cells_and_edges(self, any_tissue):
        ax = plot_tissue(any_tissue, cells=any_tissue.areas, edges=any_tissue.edge_lengths)
        faces, lines = faces_of(ax), lines_of(ax)
        areas = [shoelace(path.vertices[:-1]) for path in faces.get_paths()]
        np.testing.assert_allclose(faces.get_array(), areas)
        lengths = [np.linalg.norm(b - a) for a, b in lines.get_segments()]
        np.testing.assert_allclose(lines.get_array(), lengths, atol=1e-12)

    def test_axes_show_all_cells(self, any_tissue):
        ax = plot_tissue(any_tissue)
        polygons, _ = cell_polygons(any_tissue)
        lattice = np.asarray(any_tissue.boundary.lattice)
        points = np.concatenate([polygons.reshape(-1, 2), [[0, 0], lattice.sum(axis=0)]])
        for axis, (low, high) in enumerate((ax.get_xlim(), ax.get_ylim())):
            assert low < points[:, axis].min()
            assert points[:, axis].max() < high
        assert ax.get_aspect() == 1.0

    def test_colour_limits(self, tissue):
        areas = np.asarray(tissue.areas)
        assert faces_of(plot_tissue(tissue, areas)).get_clim() == (areas.min(), areas.max())
        assert faces_of(plot_tissue(tissue, areas, vmin=0.5)).get_clim() == (0.5, areas.max())
        ax = plot_tissue(tissue, edges=tissue.edge_lengths, edge_vmin=0, edge_vmax=9)
        assert lines_of(ax).get_clim() == (0, 9)

    def test_colour_bars(self, tissue):
        ax = plot_tissue(
            tissue, tissue.areas, tissue.edge_lengths, label="area", edge_label="length"
        )
        assert {a.get_ylabel() for a in ax.figure.axes if a is not ax} == {"area", "length"}
        ax = plot_tissue(tissue, tissue.areas, colorbar=False)
        assert ax.figure.axes == [ax]
        assert plot_tissue(tissue).figure.axes[1:] == []

    def test_colour_bars_point_beyond_limits_that_cut_values_off(self, tissue):
        areas = np.asarray(tissue.areas)
        middle = np.median(areas)
        for limits, extend in (
            ({}, "neither"),
            ({"vmin": middle}, "min"),
            ({"vmax": middle}, "max"),
            ({"vmin": middle, "vmax": middle + 1e-3}, "both"),
        ):
            faces = faces_of(plot_tissue(tissue, areas, **limits))
            assert faces.colorbar.extend == extend
            # The bar shows the extreme of the values beyond its limits.
            beyond = {"min": [areas.min()], "max": [areas.max()], "neither": []}
            beyond["both"] = beyond["min"] + beyond["max"]
            texts = [text.get_text() for text in faces.colorbar.ax.texts]
            assert texts == [f"{value:.3g}" for value in beyond[extend]]

    def test_cells_without_a_value_are_grey(self, tissue):
        values = np.arange(tissue.n_cells, dtype=float)
        values[[2, 5]] = np.nan, np.inf
        ax = plot_tissue(tissue, values)
        faces = faces_of(ax)
        assert faces.get_clim() == (0, tissue.n_cells - 1)
        ax.figure.canvas.draw()
        colours = faces.get_facecolor()
        for cell in (2, 5):
            np.testing.assert_allclose(colours[cell], to_rgba("0.85"), atol=1e-6)
        assert np.ptp(colours[3, :3]) > 0.1

    @pytest.mark.parametrize("values", [np.full(15, np.nan), np.full(15, 3.7), np.zeros(15, int)])
    def test_values_that_are_all_missing_or_all_equal_have_one_colour(self, tissue, values):
        ax = plot_tissue(tissue, values, label="value")
        ax.figure.canvas.draw()
        faces = faces_of(ax)
        low, high = faces.get_clim()
        missing = bool(np.isnan(values[0]))
        colour = to_rgba("0.85") if missing else faces.cmap(faces.norm(float(values[0])))
        np.testing.assert_allclose(faces.get_facecolor(), np.tile(colour, (15, 1)), atol=1e-6)
        assert faces.colorbar.extend == "neither"
        assert missing or low < values[0] < high

    def test_mask(self, tissue):
        mask = np.arange(tissue.n_cells) % 3 == 0
        values = np.asarray(tissue.areas)
        ax = plot_tissue(tissue, values, mask=mask)
        np.testing.assert_array_equal(faces_of(ax).get_array(), values[mask])
        perimeter = sum(np.linalg.norm(b - a) for a, b in lines_of(ax).get_segments())
        m = tissue.topology
        shared = np.asarray(mask[np.asarray(m.edge_cells)].all(axis=1))
        bound = np.asarray(tissue.perimeters)[mask].sum()
        both = np.asarray(tissue.edge_lengths)[shared].sum()
        # Sides between two marked cells are drawn once, or twice across the boundary.
        assert bound - both - 1e-9 < perimeter < bound + 1e-9
        plot_tissue(tissue, mask=np.zeros(15, bool)).figure.canvas.draw()

    def test_lines_get_thinner_with_more_cells(self, tissue):
        many = vx.initialise.periodic_voronoi(400, key=jax.random.key(0), softening=0.0)
        width = lambda t, **options: lines_of(plot_tissue(t, **options)).get_linewidth()[0]
        assert 0.1 < width(many) < 0.7 * width(tissue)
        assert width(tissue, linewidth=2.5) == 2.5

    def test_draws_in_given_axes_without_pyplot(self, tissue):
        axes = Figure().subplots(1, 2)
        assert plot_tissue(tissue, tissue.areas, ax=axes[1]) is axes[1]
        assert len(axes[0].collections) == 0
        assert plt.get_fignums() == []

    def test_settings_of_the_user_stay(self, tissue):
        before = dict(matplotlib.rcParams)
        plot_tissue(tissue, tissue.areas)
        plot_recovery(np.ones(3), np.ones(3))
        assert dict(matplotlib.rcParams) == before

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"cells": np.zeros(14)}, r"`cells` must have shape \(15,\), but its shape is \(14,\)"),
            ({"cells": np.zeros((15, 3))}, r"`cells`.*\(15, 3\)"),
            ({"edges": np.zeros(15)}, r"`edges` must have shape \(45,\)"),
            ({"mask": np.zeros(3, bool)}, r"`mask` must have shape \(15,\)"),
            ({"alpha": 1.5}, "`alpha`"),
            ({"image": np.zeros((4, 5)), "pixel_size": 0.0}, "`pixel_size`"),
            ({"image": np.zeros((4, 5, 2))}, r"`image`.*\(4, 5, 2\)"),
            ({"image": np.zeros(4)}, r"`image`.*\(4,\)"),
        ],
    )
    def test_wrong_arguments_are_named_and_leave_no_figure(self, tissue, arguments, message):
        with pytest.raises(ValueError, match=message):
            plot_tissue(tissue, **arguments)
        assert plt.get_fignums() == []

    def test_batches_are_refused(self, tissue):
        batch = jax.tree.map(lambda x: np.stack([x, x]), tissue)
        with pytest.raises(ValueError, match="must be a single tissue"):
            plot_tissue(batch)


class TestOverlay:
    IMAGE = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80)

    def test_pixels_and_tissue_share_coordinates_with_y_down(self, tissue):
        ax = plot_tissue(tissue, image=self.IMAGE, pixel_size=0.05)
        assert ax.get_xlim() == (0, 80 * 0.05)
        assert ax.get_ylim() == (60 * 0.05, 0)
        (image,) = ax.images
        # The value under the middle of the pixel in row 10, column 30.
        ax.figure.canvas.draw()
        x, y = ax.transData.transform((30.5 * 0.05, 10.5 * 0.05))
        event: Any = type("Event", (), {"x": x, "y": y, "inaxes": ax})()
        assert image.get_cursor_data(event) == self.IMAGE[10, 30]
        low = ax.transData.transform((1.0, 0.0))[1]
        assert low > ax.transData.transform((1.0, 2.0))[1]

    def test_membranes_alone_leave_the_image_visible(self, tissue):
        ax = plot_tissue(tissue, image=self.IMAGE, pixel_size=0.05)
        assert len(faces_of(ax).get_facecolor()) == 0
        np.testing.assert_allclose(lines_of(ax).get_color()[0], to_rgba("#ffb000"))

    def test_cells_have_the_colours_of_the_bar_and_leave_the_membranes_visible(self, tissue):
        ax = plot_tissue(tissue, tissue.areas, image=self.IMAGE, pixel_size=0.05)
        ax.figure.canvas.draw()
        faces = faces_of(ax)
        values = faces.get_array()
        np.testing.assert_array_equal(faces.get_facecolor(), faces.cmap(faces.norm(values)))
        drawn = [abs(shoelace(path.vertices[:-1])) for path in faces.get_paths()]
        np.testing.assert_allclose(drawn, 0.64 * values, rtol=1e-9)

    def test_cells_with_an_opacity_have_full_size(self, tissue):
        faces = faces_of(plot_tissue(tissue, tissue.areas, image=self.IMAGE, alpha=0.2))
        assert faces.get_alpha() == 0.2
        drawn = [abs(shoelace(path.vertices[:-1])) for path in faces.get_paths()]
        np.testing.assert_allclose(drawn, faces.get_array(), rtol=1e-9)

    def test_contrast_ignores_single_pixels(self, tissue):
        image = np.random.default_rng(0).normal(100, 10, (60, 80))
        image[3, 4], image[5, 6] = 1e6, -1e6
        low, high = plot_tissue(tissue, image=image).images[0].get_clim()
        assert 60 < low < 90
        assert 110 < high < 140

    def test_flat_images_are_black_and_colour_images_are_unchanged(self, tissue):
        colours = np.random.default_rng(0).integers(0, 256, (4, 5, 3)).astype(np.uint8)
        for image, expected in (
            (np.full((4, 5), 7.0), np.zeros((4, 5, 3))),
            (colours, colours / 255),
        ):
            shown: Any = plot_tissue(tissue, image=image).images[0]
            pixels = shown.to_rgba(shown.get_array(), norm=True)
            np.testing.assert_allclose(pixels[..., :3], expected, atol=1e-6)


class TestHistory:
    def history(self, cost):
        values: Any = {field.name: 0 * cost for field in dataclasses.fields(History)}
        counts = np.resize([3, 0, 1, 0], cost.shape)
        values |= {"seconds": np.ones(4), "guidance": np.ones(4), "converged": counts >= 0}
        values |= {"relative_error": np.nan * cost, "max_force": 1e-8 + 0 * counts}
        return History(**values | {"cost": cost, "num_steps": counts, "num_t1": counts})

    def test_a_panel_for_each_known_curve(self):
        panels = plot_history(self.history(np.array([1.0, 0.1, np.nan, 0.0])))
        names = [panel.get_ylabel() for panel in panels]
        assert names == ["cost", "largest force", "T1 transitions"]
        assert [panel.get_yscale() for panel in panels] == ["log", "log", "linear"]
        drawn: Any = panels[0].lines[0].get_ydata()
        np.testing.assert_array_equal(drawn, [1.0, 0.1, np.nan, np.nan])
        panels[0].figure.canvas.draw()

    def test_negative_costs_get_a_linear_axis(self):
        panel, *_ = plot_history(self.history(np.array([1.0, -1.0, 0.0, 1.0])))
        assert panel.get_yscale() == "linear"

    def test_the_history_of_a_batch_is_refused(self):
        with pytest.raises(
            ValueError, match=r"`history` must have shape \(4,\), but its shape is \(4, 2\)"
        ):
            plot_history(self.history(np.ones((4, 2))))


class TestRecovery:
    TRUE = np.array([1.0, 2.0, 3.0, 4.0])

    def test_numbers(self):
        inferred = np.array([1.1, 2.0, 3.0, 4.0])
        ax = plot_recovery(self.TRUE, inferred, np.full(4, 2.5))
        (text,) = ax.texts
        r = np.corrcoef(self.TRUE, inferred)[0, 1]
        assert f"{r:.4f}" in text.get_text()
        assert "2.5 %" in text.get_text()
        offsets: Any = [c.get_offsets() for c in ax.collections]
        np.testing.assert_array_equal(offsets[-1][:, 1], inferred)
        np.testing.assert_array_equal(offsets[0][:, 1], 2.5)
        diagonal: Any = ax.lines[0]
        assert diagonal.get_xy1() == (0, 0)
        assert diagonal.get_slope() == 1

    def test_several_fits_share_a_diagonal_and_are_in_the_limits(self):
        ax = plot_recovery(self.TRUE, self.TRUE + 5, label="far", deviation=np.full(4, 0.5))
        plot_recovery(self.TRUE - 3, self.TRUE - 3, ax=ax, label="near", colour="red", marker="^")
        assert len([line for line in ax.lines if hasattr(line, "get_slope")]) == 1
        assert ax.get_xlim() == ax.get_ylim()
        assert ax.get_xlim()[0] < -2
        assert ax.get_xlim()[1] > 9
        assert len(ax.texts) == 0
        assert ax.get_legend_handles_labels()[1] == ["far", "near"]
        (bars,) = (c for c in ax.collections if isinstance(c, LineCollection))
        np.testing.assert_allclose([np.ptp(s[:, 1]) for s in bars.get_segments()], 1.0)

    def test_missing_parameters_are_omitted(self):
        true, inferred = np.append(self.TRUE, np.nan), np.append(self.TRUE, 100.0)
        ax = plot_recovery(true, inferred)
        points: Any = ax.collections[0].get_offsets()
        np.testing.assert_array_equal(points[:, 0], self.TRUE)
        assert "$r$ = 1.0000" in ax.texts[0].get_text()
        assert ax.get_ylim()[1] < 5

    def test_draws_in_a_given_figure(self):
        figure = Figure()
        assert plot_recovery(self.TRUE, self.TRUE, figure=figure).figure is figure
        assert plt.get_fignums() == []
        with pytest.raises(ValueError, match="`figure` must be empty"):
            plot_recovery(self.TRUE, self.TRUE, figure=figure)
        with pytest.raises(ValueError, match="`ax` and `figure` must not both be given"):
            plot_recovery(self.TRUE, self.TRUE, ax=figure.axes[0], figure=Figure())

    def test_undefined_numbers_are_left_out(self):
        text = plot_recovery(np.full(3, 3.7), np.array([3.6, 3.7, 3.8])).texts[0].get_text()
        assert "$r$" not in text
        assert "error" in text
        text = plot_recovery(np.array([0.0, 1.0]), np.array([0.1, 1.0])).texts[0].get_text()
        assert "$r$" in text
        assert "error" not in text

    def test_one_parameter_in_given_axes(self):
        ax = Figure().subplots()
        assert plot_recovery(np.zeros(1), np.zeros(1), ax=ax) is ax
        assert plt.get_fignums() == []

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match=r"`inferred` must have shape .* each entry of `true`"):
            plot_recovery(self.TRUE, np.ones(3))
        with pytest.raises(ValueError, match=r"`initial` must have shape .* each entry of `true`"):
            plot_recovery(self.TRUE, self.TRUE, np.ones(3))
        with pytest.raises(
            ValueError, match=r"`deviation` must have shape .* each entry of `true`"
        ):
            plot_recovery(self.TRUE, self.TRUE, deviation=np.ones(3))
        with pytest.raises(ValueError, match="at least one parameter"):
            plot_recovery(np.ones(0), np.ones(0))
