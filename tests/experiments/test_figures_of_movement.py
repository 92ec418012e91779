"""The figures of experiments in time, from numbers made up."""

from types import SimpleNamespace

import numpy as np
import pytest

import vertax as vx
from experiments import cell_diffusion, movement_checks, oscillatory_shear, timed_elongation

pytestmark = pytest.mark.experiments


def test_moduli_have_points_on_lines():
    frequencies = np.geomspace(0.1, 10, 4)
    expected = 1 + 1j * frequencies
    figure = oscillatory_shear.plot_moduli(
        frequencies, {"one": expected, "two": expected}, {"one": expected, "two": expected}
    )
    figure.canvas.draw()
    assert [ax.get_title() for ax in figure.axes] == ["one", "two"]
    points, line = figure.axes[0].lines[:2]
    np.testing.assert_array_equal(points.get_ydata(), line.get_ydata())


def test_nan_diffusion_is_not_drawn():
    config = cell_diffusion.Config(shape_factors=[3.5, 3.7], speeds=[0.2])
    lags = np.arange(1.0, 5.0)
    squared = np.ones((1, 2, 4)) * lags
    squared[0, 1, 2:] = np.nan
    coefficients = np.array([[0.1, np.nan]])
    figure = cell_diffusion.plot_diffusion(config, lags, squared, coefficients, coefficients)
    figure.canvas.draw()
    shown = np.asarray(figure.axes[1].lines[0].get_ydata(), float)
    np.testing.assert_array_equal(np.isnan(shown), [False, True])
    free = np.asarray(figure.axes[0].lines[-1].get_ydata(), float)
    # A persistent walk is straight at first, and diffuses in the end.
    early = 2 * 0.2**2 * (1e-3 - 1 + np.exp(-1e-3)) / (0.2 * 1e-3) ** 2
    assert early == pytest.approx(1, rel=1e-3)
    assert free[-1] == pytest.approx(2 * 0.2**2 * (4 - 1 + np.exp(-4)))


def test_transitions_of_all_time_steps_are_drawn():
    steps = np.array([0.5, 0.25])
    results = SimpleNamespace(
        decay_steps=steps,
        decay_errors=np.stack([steps, steps**2]),
        quench_times=[np.linspace(0, 1, n + 1) for n in (2, 4)],
        quench_energies=[np.linspace(2, 1, n + 1) for n in (2, 4)],
        # The edge 9 flips only where steps are long.
        events=[np.array([[3, 0.5], [9, 1.0]]), np.array([[3, 0.25], [5, 0.75]])],
        eigenvalues=np.array([1.0, 2.0]),
        mode_energies=np.ones(2),
        differences=np.array([1e-3, 1e-2]),
        gradient_errors=np.full((2, 2), 1e-6),
        control_errors=np.full((2, 2), 1e-3),
        control_steps=np.full((2, 2), 7),
    )
    figure = movement_checks.plot_checks(movement_checks.Config(tolerances=[1e-2, 1e-3]), results)
    figure.canvas.draw()
    events = figure.axes[2].lines
    points = sorted(tuple(xy) for line in events for xy in line.get_xydata().tolist())
    assert points == [(0.25, 0.25), (0.25, 0.75), (0.5, 0.5), (0.5, 1.0)]


def test_the_course_is_drawn_with_the_aspect_ratios():
    tissue = vx.initialise.free_voronoi(6, key=0, lloyd_steps=1)
    tensions = np.linspace(0.1, 0.2, tissue.n_edges)
    times = np.linspace(0, 1, 4)
    figure = timed_elongation.plot_course(
        {"first": (tissue, tensions), "last": (tissue, tensions)},
        (0.04, 0.28),
        times,
        1 + times,
        {"constant": 1 + 0 * times, "timed": 1 + times},
    )
    figure.canvas.draw()
    legend = figure.axes[2].get_legend()
    assert legend is not None
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == ["asked for", "constant tensions", "timed tensions"]
