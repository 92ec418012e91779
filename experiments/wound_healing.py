r"""Closure of a wound by the pressure of a compressed tissue, without migration: a reference model of OpenVT.

The tissue, the wound and the energy are those of Chaste (`test/Test03WoundHealing.hpp` of Chaste/OpenVT): 168
cells of the target area 1 fill a periodic box of 10 × 10, and the cells of a diagonal band die. The energy is

$$50 \sum_c (A_c - 1)^2 + \sum_c (P_c - 2 \sqrt\pi)^2 + 2 \sum_e \ell_e ,$$

here divided by 50, so that a unit of time is 1/50 of that of Chaste. The target area and the line tension are
recovered from a movie with noise in the positions.
"""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import comparison, processor_time
from experiments.adhesions_from_movie import with_noise
from vertax import energies, plotting, runs
from vertax.inference import Movie, fit_movie

PERIMETER = 2 * np.pi**0.5
"""Target perimeter of a cell, that of a disc."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    columns: int = Field(default=12, ge=6)
    """Cells in a row of the honeycomb, which fills the box."""
    rows: int = Field(default=14, ge=6, multiple_of=2)
    """Rows."""
    disorder: float = Field(default=0.03, ge=0)
    """Standard deviation of the centres about those of the honeycomb."""
    stiffness: float = Field(default=2.0, gt=0)
    """Stiffness of areas, in $\\tfrac12 K (A - A_0)^2$."""
    target_area: float = Field(default=1.0, gt=0)
    """Target area of a cell, above the mean area: the tissue is under pressure."""
    contractility: float = Field(default=0.04, ge=0)
    """Stiffness of perimeters."""
    tension: float = Field(default=0.04, ge=0)
    """Line tension of all edges."""
    duration: float = Field(default=20.0, gt=0)
    """Duration after the wound."""
    frames: int = Field(default=160, ge=6)
    """Frames after the first one."""
    substeps: int = Field(default=2, ge=1)
    """Steps per frame."""
    noise: float = Field(default=0.01, ge=0)
    """Standard deviation of positions; at most a fifth of the shortest edge of the vertex."""
    fitted_until: float = Field(default=0.4, ge=0, lt=1)
    """Part of the area of the wound that is left in the last frame of the fit; later its sides touch."""
    tolerance: float = Field(default=1e-4, gt=0)
    """Largest force after a step."""


def energy_of(config: Config, target_area: Any, tension: Any) -> Any:
    """The energy of the tissue."""
    perimeters = energies.PerimeterElasticity(config.contractility, PERIMETER)
    areas = energies.AreaElasticity(config.stiffness, target_area)
    return areas + perimeters + energies.LineTension(tension)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """The area of the wound in time, the times of closure, and the recovered parameters."""
    rng, side = np.random.default_rng(config.seed), 10.0
    row, column = np.divmod(np.arange(config.columns * config.rows), config.columns)
    seeds = np.stack([(column + 0.5 * (row % 2)) / config.columns, row / config.rows], axis=1)
    seeds = side * seeds + config.disorder * rng.normal(size=seeds.shape)
    tissue = vx.initialise.periodic_voronoi(seeds=seeds, lattice=side * np.eye(2))
    tissue = tissue.with_capacity(tissue.n_cells)
    x, y = np.mod(np.asarray(tissue.centroids), side).T
    inside = (np.minimum(x, y) > 2) & (np.maximum(x, y) < 8)
    killed = inside & (np.abs(x - y) < 2)
    energy = energy_of(config, config.target_area, config.tension)
    wounded, passive = vx.transitions.ablate(tissue, energy, cells=killed)
    hole = jnp.asarray(killed) & wounded.alive
    times = np.linspace(0, config.duration, config.frames + 1)
    relaxation = vx.Relaxation(transitions=vx.T1() + vx.T2(), tolerance=config.tolerance)

    def heal() -> Any:
        options: Any = {"substeps": config.substeps, "relaxation": relaxation, "throw": False}
        movie = vx.evolve(wounded, passive, vx.dissipations.SubstrateFriction(1.0), times, **options)
        return movie, np.array([jnp.sum(jnp.where(hole, frame.areas, 0)) for frame in movie.trajectory])

    heal()  # compiles
    (movie, areas), seconds = processor_time(heal)
    if not movie.converged:
        folder.warn(f"A step failed: {vx.RESULTS[movie.result]}")
    left = areas / areas[0]
    closure = {f"{part:g}": first_below(times, left, part) for part in (0.5, 0.1, 0.01)}
    frames = list(movie.trajectory)
    used = np.flatnonzero(np.cumprod(left >= config.fitted_until))
    noisy = [with_noise(frames[k], config.noise, rng) for k in used]
    guess = energies.Ablated(
        energy_of(config, jnp.array(0.8 * config.target_area), jnp.array(0.0)),
        cells=np.asarray(hole)[np.asarray(wounded.alive)],
    )
    with warnings.catch_warnings(record=True) as stated:
        warnings.simplefilter("always", UserWarning)
        fit = fit_movie(Movie(noisy, times[used], largest_jump=3.0), guess, noise=config.noise)
    for warning in stated:
        folder.warn(str(warning.message).rstrip("."), "fit")
    results: Any = [fit.energy, fit.deviation]
    fitted, errors = ([e.energy.terms[0].target_area, e.energy.terms[2].tension] for e in results)
    folder.save_table("wound", {"time": times, "area": areas})
    folder.save_figure("wound", plot_wound(frames, hole, times, areas, int(used[-1])))
    return {
        "cells": int(np.sum(wounded.alive)) - 1,
        "area": float(areas[0]),
        "times_of_closure": closure,
        "area_at_the_end": float(areas[-1]),
        "t1": int(movie.num_t1),
        "target_area": comparison(fitted[0], errors[0], config.target_area),
        "tension": comparison(fitted[1], errors[1], config.tension),
        "fitted_frames": len(used),
        "seconds_per_step": seconds / config.frames / config.substeps,
    }


def first_below(times: np.ndarray, left: np.ndarray, part: float) -> float:
    """The time at which a decreasing curve passes a value; infinity if it does not."""
    if left.min() > part:
        return np.inf
    k = int(np.argmax(left <= part))
    return float(np.interp(part, [left[k], left[k - 1]], [times[k], times[k - 1]]))


@plotting.house_style()
def plot_wound(frames: list[vx.Tissue], hole: Any, times: np.ndarray, areas: np.ndarray, last: int) -> Any:
    """Three frames in the colours of the areas of cells, and the area of the wound in time."""
    figure, (axes,) = plotting.new_figure(1, 4, width=[2.0, 2.0, 2.0, 2.4], height=2.2, room=0.6)
    chosen = np.unique([0, last, len(frames) - 1])
    tissues = {f"time {times[k]:.3g}": frames[k] for k in chosen}
    values = [np.where(hole, np.nan, np.asarray(frames[k].areas)) for k in chosen]
    plotting.plot_tissues(tissues, values, axes=axes[: len(chosen)], label="area")
    axes[3].semilogy(times, areas, color=plotting.SERIES[0])
    axes[3].axvspan(0, times[last], color=plotting.SERIES[0], alpha=0.12, lw=0, label="fitted")
    axes[3].set(xlabel="time", ylabel="area of the wound")
    axes[3].legend()
    return figure
