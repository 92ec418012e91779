"""A Turing pattern on a tissue that grows: spots appear and keep their spacing.

The cells of a free cluster grow and divide, and an activator and an inhibitor (Schnakenberg 1979,
doi:10.1016/0022-5193(79)90042-0) react in them and pass to neighbours. Daughters share the amounts of their
mother. Linear theory gives the wavelength, and a hexagonal pattern one spot for each 2/√3 wavelengths squared
(as Crampin, Gaffney & Maini 1999, doi:10.1006/bulm.1999.0131, for growing domains).
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import vertax as vx
from vertax import energies, plotting, runs
from vertax.plotting import INK, SERIES


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    founders: int = Field(default=40, ge=4)
    """Cells at the start, of mean area 1."""
    room: int = Field(default=240, ge=8)
    """Largest number of cells at a time."""
    duration: float = Field(default=85.0, gt=0)
    """Duration of growth."""
    frames: int = Field(default=34, ge=3)
    """Frames after the first one."""
    substeps: int = Field(default=5, ge=1)
    """Steps per frame."""
    growth_rate: float = Field(default=0.02, ge=0)
    """Rate of growth of target areas."""
    production: list[float] = Field(default=[0.1, 0.9], min_length=2, max_length=2)
    """Production of the activator and of the inhibitor."""
    diffusion: list[float] = Field(default=[0.15, 3.0], min_length=2, max_length=2)
    """Diffusion of the activator and of the inhibitor, area per time."""
    animation: bool = True
    """Draw an animation."""


class Schnakenberg(vx.signals.AbstractReaction):
    """An activator u and an inhibitor v: u' = a - u + u² v, v' = b - u² v."""

    production: Any

    def __call__(self, concentrations: Any, cells: Any, time: Any) -> Any:
        """The rates of change of both."""
        (u, v), (a, b) = concentrations, self.production
        return jnp.stack([a - u + u**2 * v, b - u**2 * v])


def energy(cells: vx.growth.Cells) -> vx.AbstractEnergy:
    """The energy of a growing tissue as a function of its cells."""
    areas = energies.AreaElasticity(10.0, cells.target_area)
    return areas + energies.PerimeterElasticity(1.0, 3.6 * jnp.sqrt(cells.target_area))


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The number of spots in each frame, and that of linear theory."""
    began = time.perf_counter()
    tissue = vx.initialise.free_voronoi(config.founders, key=config.seed, lloyd_steps=2)
    tissue = vx.Tissue(tissue.vertices, tissue.topology, tissue.boundary).with_capacity(config.room)
    (a, b), noise = config.production, np.random.default_rng(config.seed)
    state = np.array([a + b, b / (a + b) ** 2])[:, None]
    signals = vx.signals.Signals(
        Schnakenberg(jnp.asarray(config.production)),
        config.diffusion,
        initial=state * (1 + 0.1 * noise.uniform(-1, 1, (2, config.room))),
        max_steps=2000,
    )
    times = np.linspace(0, config.duration, config.frames + 1)
    cycle = vx.growth.GrowAndDivide(config.growth_rate, 1.5)
    grown = vx.growth.grow(
        tissue,
        energy,
        cycle,
        times,
        key=config.seed,
        substeps=config.substeps,
        activity=signals,
        throw=False,
    )
    if not grown.converged:
        folder.warn(f"A step failed: {vx.RESULTS[grown.result]}")
    frames = list(grown.trajectory)
    activator = np.where(np.asarray(grown.number) >= 0, np.asarray(grown.signals)[:, 0], np.nan)
    spots = np.array([spot_count(t, u) for t, u in zip(frames, activator, strict=True)])
    areas = np.array([float(jnp.sum(frame.areas)) for frame in frames])
    wavelength = fastest_wavelength(config)
    expected = areas / (2 / np.sqrt(3) * wavelength**2)
    cells = np.asarray(grown.n_alive)
    table = {"time": times, "cells": cells, "area": areas, "spots": spots, "spots_of_theory": expected}
    folder.save_table("spots", table)
    folder.save_tissue("grown", grown.tissue)
    folder.save_figure("pattern", plot_pattern(frames, activator, table))
    if config.animation:
        (folder.path / "figures").mkdir(exist_ok=True)
        file = folder.path / "figures" / "pattern.gif"
        vx.animate(grown.trajectory, file, activator, mark_t1=0, dpi=90, label="activator")
    return {
        "cells": int(cells[-1]),
        "spots": float(spots[-1]),
        "spots_of_theory": float(expected[-1]),
        "wavelength_of_theory": wavelength,
        "converged": bool(grown.converged),
        "seconds": time.perf_counter() - began,
    }


def fastest_wavelength(config: Config) -> float:
    """The wavelength of the mode that grows fastest from the uniform state, for the diffusion equation."""
    a, b = config.production
    u, v = a + b, b / (a + b) ** 2
    jacobian = np.array([[2 * u * v - 1, u**2], [-2 * u * v, -(u**2)]])
    wave_numbers = np.linspace(0.05, 4, 4000)
    matrices = jacobian - wave_numbers[:, None, None] ** 2 * np.diag(config.diffusion)
    growth = np.linalg.eigvals(matrices).real.max(axis=-1)
    return float(2 * np.pi / wave_numbers[np.argmax(growth)])


def spot_count(tissue: vx.Tissue, activator: np.ndarray) -> float:
    """The number of connected groups of cells with 1.5 times the mean activator; 1/2 each on the outline."""
    cells, n = np.asarray(tissue.topology.edge_cells), tissue.n_cells
    high = np.append(activator > 1.5 * np.nanmean(activator), [False, False])  # (NaN is not)
    first, second = cells[high[cells].all(axis=1)].T
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(n, n))
    labels = connected_components(graph, directed=False)[1]
    outer = np.unique(cells[np.asarray(tissue.topology.on_outline), 0])
    groups = np.unique(labels[high[:n]])
    return len(groups) - 0.5 * np.sum(np.isin(groups, labels[outer[high[outer]]]))


@plotting.house_style()
def plot_pattern(frames: list[vx.Tissue], activator: np.ndarray, table: dict[str, np.ndarray]) -> Any:
    """Three frames, and the number of spots in time."""
    figure, (axes,) = plotting.new_figure(1, 4, width=[2.0, 2.0, 2.0, 2.6], height=2.2, room=0.6)
    chosen = np.linspace(0, len(frames) - 1, 4).round().astype(int)[1:]
    tissues = {f"time {table['time'][k]:g}": frames[k] for k in chosen}
    options: Any = {"vmin": 0, "vmax": np.nanmax(activator), "label": "activator"}
    plotting.plot_tissues(tissues, [activator[k] for k in chosen], axes=axes[:3], **options)
    axes[3].plot(table["cells"], table["spots"], ".", color=SERIES[0], label="spots")
    axes[3].plot(table["cells"], table["spots_of_theory"], "-", color=INK, label="area over theory")
    axes[3].set(xlabel="cells", ylabel="number")
    axes[3].legend()
    return figure
