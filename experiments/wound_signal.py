"""Closure of a wound by a purse string that a signal of damage contracts.

A hole releases a signal, which passes from cell to cell and decays. The signal of a cell sets the tension of
its edges at the hole, so the wound closes faster if the signal spreads faster.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from vertax import plotting, runs
from vertax.energies import ShapeFactorEnergy
from vertax.plotting import SERIES


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: int = Field(default=49, ge=16)
    """Number of cells of the periodic tissue, of mean area 1."""
    duration: float = Field(default=16.0, gt=0)
    """Duration after the wound."""
    frames: int = Field(default=48, ge=3)
    """Frames after the first one."""
    substeps: int = Field(default=2, ge=1)
    """Steps per frame."""
    tension: float = Field(default=3.0, ge=0)
    """Tension of an edge at the hole for a saturating signal."""
    diffusion: list[float] = Field(default=[0.0, 0.1, 1.0], min_length=1)
    """Exchange of the signal, one run for each value."""
    decay: float = Field(default=1.0, ge=0)
    """Rate of decay in living cells."""
    half: float = Field(default=0.1, gt=0)
    """Concentration of half of the tension; that of the hole is 1."""
    target_area: float = Field(default=1.4, gt=0)
    """Target area of a cell, above the mean area: the tissue is under pressure."""


class Damage(vx.signals.AbstractReaction):
    """A hole holds the concentration 1, and the signal decays in other cells."""

    hole: Any
    decay: Any

    def __call__(self, concentrations: Any, cells: Any, time: Any) -> Any:
        """The rate of change."""
        return jnp.where(self.hole, 20 * (1 - concentrations), -self.decay * concentrations)


class PurseString(vx.AbstractLocalEnergy):
    """A tension of the edges between the hole and other cells, which depends on the cell.

    Edges that lose the hole in a T1 transition lose the tension at once. (With a `LineTension` they would
    keep it for the rest of the time step, so no edge would flip, and the hole would never close.)
    """

    hole: Any
    tension: Any

    def edge_terms(self, tissue: vx.Tissue) -> Any:
        """Energy of each edge."""
        sides = tissue.topology.edge_cells
        at_hole = self.hole.at[sides].get(mode="fill", fill_value=False)
        tension = jnp.where(at_hole, 0, self.tension.at[sides].get(mode="fill", fill_value=0))
        return jnp.where(at_hole.any(axis=-1), tension.sum(axis=-1), 0) * tissue.edge_lengths


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The area of the hole in time, and the time at which it has vanished, for each diffusion."""
    began, n = time.perf_counter(), config.n_cells
    tissue = vx.initialise.periodic_voronoi(n, key=config.seed, lloyd_steps=20).with_capacity(n)
    energy = ShapeFactorEnergy(3.8, config.target_area)
    rest = vx.equilibrate(tissue, energy).tissue
    cells = np.asarray(rest.topology.edge_cells)
    killed = np.isin(np.arange(n), cells[np.any(cells == 0, axis=1)])
    wounded, passive = vx.transitions.ablate(rest, energy, cells=killed)
    hole = jnp.asarray(killed) & wounded.alive
    times = np.linspace(0, config.duration, config.frames + 1)
    relaxation = vx.Relaxation(transitions=vx.T1() + vx.T2())

    def couple(concentrations: Any, tissue: vx.Tissue) -> vx.AbstractEnergy:
        c = jnp.maximum(concentrations[0], 0)
        return PurseString(hole, config.tension * c / (c + config.half))

    movies, areas, closed = [], [], []
    for diffusion in config.diffusion:
        damage = Damage(hole, jnp.asarray(config.decay))
        signals = vx.signals.Signals(damage, [diffusion], initial=hole[None] * 1.0, couple=couple)
        movie = vx.evolve(
            wounded,
            passive,
            vx.dissipations.SubstrateFriction(1.0),
            times,
            substeps=config.substeps,
            activity=signals,
            relaxation=relaxation,
            throw=False,
        )
        if not movie.converged:
            folder.warn(f"Diffusion {diffusion:g}: {vx.RESULTS[movie.result]}")
        movies.append(movie)
        areas.append([float(jnp.sum(jnp.where(hole, frame.areas, 0))) for frame in movie.trajectory])
        done = np.array(areas[-1]) == 0
        closed.append(float(times[np.argmax(done)]) if done.any() else np.inf)
    columns = {f"area_{d:g}": np.array(a) for d, a in zip(config.diffusion, areas, strict=True)}
    folder.save_table("areas", {"time": times} | columns)
    folder.save_figure("wound", plot_wound(movies[-1], hole, times, columns))
    return {
        "area_of_the_wound": areas[0][0],
        "times_of_closure": closed,
        "seconds": time.perf_counter() - began,
    }


@plotting.house_style()
def plot_wound(movie: Any, hole: Any, times: np.ndarray, columns: dict[str, np.ndarray]) -> Any:
    """Three frames of the last run in the colours of the signal, and the area of the hole in time."""
    figure, (axes,) = plotting.new_figure(1, 4, width=[2.0, 2.0, 2.0, 2.4], height=2.2, room=0.6)
    frames = list(movie.trajectory)
    area = np.asarray(list(columns.values())[-1])
    last = int(np.argmax(area == 0)) or len(frames) - 1
    chosen = [1, max(last // 2, 2), max(last, 3)]
    tissues = {f"time {times[k]:.2g}": frames[k] for k in chosen}
    values = [np.where(hole, np.nan, np.asarray(movie.signals)[k, 0]) for k in chosen]
    plotting.plot_tissues(tissues, values, axes=axes[:3], vmin=0, label="signal")
    for k, (name, values) in enumerate(columns.items()):
        axes[3].plot(times, values, color=SERIES[k], label=f"D = {name.removeprefix('area_')}")
    axes[3].set(xlabel="time", ylabel="area of the hole", ylim=(0, None))
    axes[3].legend()
    return figure
