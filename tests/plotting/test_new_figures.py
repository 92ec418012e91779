"""New figures and their style."""

import matplotlib
import numpy as np
import pytest
from helpers import random_tissue
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from vertax.plotting import house_style, new_figure, plot_tissue


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    plt.close("all")


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

    def test_a_figure_is_filled_once(self):
        tissue, figure = random_tissue(4, 0), Figure()
        assert plot_tissue(tissue, tissue.areas, figure=figure).figure is figure
        with pytest.raises(ValueError, match="`figure` must be empty"):
            plot_tissue(tissue, figure=figure)
