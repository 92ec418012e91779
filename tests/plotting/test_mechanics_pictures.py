"""Stress crosses and arrows of modes."""

import numpy as np
import pytest
from helpers import random_tissue
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.quiver import Quiver

from vertax.plotting import cell_polygons, plot_mode, plot_stress

tissue = random_tissue(9, 2)


@pytest.fixture(autouse=True)
def no_figures_left():
    yield
    plt.close("all")


def test_crosses_lie_along_the_principal_directions_and_are_as_long_as_stresses():
    stress = np.array([[3.0, 0.0], [0.0, -1.5]])
    ax = plot_stress(tissue, np.broadcast_to(stress, (9, 2, 2)), scale=3.0)
    bars = [c for c in ax.collections if isinstance(c, LineCollection)][-1]
    size = float(np.sqrt(np.mean(tissue.areas)))
    ways = np.abs(np.diff(np.array(bars.get_segments()), axis=1)[:, 0])
    np.testing.assert_allclose(ways[0::2], [[0, size / 2]] * 9, atol=1e-12)
    np.testing.assert_allclose(ways[1::2], [[size, 0]] * 9, atol=1e-12)
    # Tension is red, pressure blue.
    blue, red = np.asarray(bars.get_colors())[:2, [0, 2]]
    assert blue[1] > blue[0]
    assert red[0] > red[1]


def test_arrows_begin_at_corners_of_drawn_cells():
    moves = np.zeros((18, 2))
    moves[4] = (0.0, 2.0)
    ax = plot_mode(tissue, moves)
    (arrows,) = [c for c in ax.collections if isinstance(c, Quiver)]
    away = np.asarray(arrows.XY)[:, None] - cell_polygons(tissue)[0].reshape(-1, 2)
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1).min(axis=1), 0, atol=1e-12)
    assert np.asarray(arrows.V)[4] == pytest.approx(float(np.sqrt(np.mean(tissue.areas))))
    assert np.abs(arrows.U).max() == 0


def test_invalid_arguments_raise(without_type_checks):
    with pytest.raises(ValueError, match="`stresses` must have shape"):
        plot_stress(tissue, np.zeros((4, 2, 2)))
    with pytest.raises(ValueError, match="`scale` must be positive"):
        plot_stress(tissue, np.zeros((9, 2, 2)), scale=0.0)
    with pytest.raises(ValueError, match="`displacements` must have shape"):
        plot_mode(tissue, np.zeros((4, 2)))
