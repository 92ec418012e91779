"""Stress crosses, arrows of modes, moduli, densities of states and stress over strain."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.quiver import Quiver

import vertax as vx
from vertax.mechanics import Ramp
from vertax.plotting import (
    plot_density_of_states,
    plot_mode,
    plot_moduli,
    plot_stress,
    plot_stress_strain,
)

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


def test_arrows_begin_at_vertices_in_the_box():
    moves = np.zeros((18, 2))
    moves[4] = (0.0, 2.0)
    ax = plot_mode(tissue, moves)
    (arrows,) = [c for c in ax.collections if isinstance(c, Quiver)]
    assert arrows.XY.min() >= 0
    assert arrows.XY.max() <= np.asarray(tissue.boundary.lattice).max()
    assert np.asarray(arrows.V)[4] == pytest.approx(float(np.sqrt(np.mean(tissue.areas))))
    assert np.abs(arrows.U).max() == 0


def test_moduli_and_densities():
    omega = np.array([0.0, 1.0, 10.0])
    ax = plot_moduli(omega, np.array([1, 1 + 1j, 2 + 0.5j]), label="a")
    storage, loss = ax.lines
    np.testing.assert_allclose(np.asarray(storage.get_ydata()), [1, 2])
    np.testing.assert_allclose(np.asarray(loss.get_ydata()), [1, 0.5])
    assert ax.get_xscale() == "log"
    (line,) = plot_density_of_states(np.array([0.5, 1.5]), np.array([0.2, 0.4])).lines
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [0.2, 0.4])


def slow_shear():
    stresses = np.zeros((5, 2, 2))
    stresses[:, 0, 1] = stresses[:, 1, 0] = [0.0, 1.0, 0.5, 1.5, 2.0]
    stresses[:, 0, 0] = 3.0
    frames = jax.tree.map(lambda x: jnp.stack([x] * 5), eqx.filter(tissue, eqx.is_array))
    t1, last = jnp.array([7, 0, 4, 0, 0]), vx.RESULTS.nonlinear_max_steps_reached
    rest = jax.vmap(lambda i: vx.RESULTS.where(i < 4, vx.RESULTS.successful, last))(jnp.arange(5))
    return Ramp(jnp.arange(5) * 0.1, frames, jnp.zeros(5), jnp.asarray(stresses), t1, rest)


def test_stress_over_strain_breaks_at_plastic_events():
    ax = plot_stress_strain(slow_shear(), label="slow")
    curve, event = ax.lines
    np.testing.assert_allclose(np.asarray(curve.get_ydata()), [0, 1, np.nan, 0.5, 1.5, np.nan])
    np.testing.assert_allclose(np.asarray(event.get_xydata()), [[0.1, 1], [0.2, 0.5]])
    # Transitions before the first strain are not events of the ramp.
    (dots,) = ax.collections
    np.testing.assert_allclose(np.asarray(dots.get_offsets()), [[0.2, 0.5]])
    assert ax.get_ylabel() == r"stress $\sigma_{xy}$"
    ax = plot_stress_strain(slow_shear(), component="xx-yy")
    np.testing.assert_allclose(np.asarray(ax.lines[0].get_ydata()), [3, 3, np.nan, 3, 3, np.nan])


def test_invalid_arguments_raise(without_type_checks):
    with pytest.raises(ValueError, match="`stresses` must have shape"):
        plot_stress(tissue, np.zeros((4, 2, 2)))
    with pytest.raises(ValueError, match="`scale` must be positive"):
        plot_stress(tissue, np.zeros((9, 2, 2)), scale=0.0)
    with pytest.raises(ValueError, match="`displacements` must have shape"):
        plot_mode(tissue, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="one entry for each of `frequencies`"):
        plot_moduli(np.ones(2), np.ones(3, complex))
    with pytest.raises(ValueError, match="one entry for each of `frequencies`"):
        plot_density_of_states(np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="must be one of xy, xx-yy"):
        plot_stress_strain(slow_shear(), component="yx")  # pyright: ignore[reportArgumentType]
    several = jax.tree.map(lambda x: np.stack([x, x]), eqx.filter(slow_shear(), eqx.is_array))
    with pytest.raises(ValueError, match=r"one entry for each of `ramp.strains`"):
        plot_stress_strain(several)
