"""Recover the adhesions of a sorting tissue from a movie with noise, and forecast the unlike length.

A tenth of the frames of a run of the sorting benchmark, with noise in the positions, is fitted across its T1
transitions. The fitted energy continues the run from the last fitted frame with other noise; the length of
contacts between unlike cells is compared with that of the run.
"""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._sorting import ADHESIONS, Model, honeycomb, unlike_length
from vertax import plotting, runs
from vertax.energies import AreaElasticity, by_type
from vertax.inference import Movie, fit_movie


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    duration: float = Field(default=300.0, gt=0)
    """Duration of the part that is fitted."""
    forecast: float = Field(default=100.0, gt=0)
    """Duration of the forecast."""
    every: int = Field(default=10, ge=1)
    """The run has a frame per unit of time; the fit uses one in `every`."""
    noise: float = Field(default=0.02, ge=0)
    """Standard deviation of positions; at most a fifth of the shortest edge of the vertex."""
    seeds: int = Field(default=5, ge=2)
    """Forecasts with other noise."""
    model: Model = Model()
    """The vertex model."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Adhesions, standard errors and true values, and the forecast beside the true length at the end."""
    model, rng = config.model, np.random.default_rng(config.seed)
    types = model.types("sorting")
    times = np.arange(round(config.duration + config.forecast) + 1.0)
    energy = model.energy("sorting")
    simulated = model.evolution(times, key=config.seed)(honeycomb(model.across), energy)
    used = np.arange(0, round(config.duration) + 1, config.every)
    frames = list(simulated.trajectory)
    noisy = [with_noise(frames[k], config.noise, rng) for k in used]
    movie = Movie(noisy, times[used], types=dict(enumerate(types.tolist())), largest_jump=3.0)
    guess = by_type(0.1 * jnp.ones((2, 2)), types, outline=jnp.array(0.1))
    with warnings.catch_warnings(record=True) as stated:
        warnings.simplefilter("always", UserWarning)
        fit = fit_movie(movie, AreaElasticity(1.0, 1.0) + guess, noise=config.noise)
    for warning in stated:
        folder.warn(str(warning.message).rstrip("."), "fit")
    energies: list[Any] = [fit.energy, fit.deviation]
    tensions = [energy.terms[1] for energy in energies]
    values, deviations = (np.append(each.tension, each.outline) for each in tensions)
    table, outline = ADHESIONS["sorting"]
    true = np.append(model.inner_factor * np.array(table)[np.triu_indices(2)], outline)
    names = ["plain-plain", "mixed", "labelled-labelled", "outline"]
    folder.save_table("adhesions", {"contact": names, "fitted": values, "error": deviations, "true": true})
    later = times[used[-1] :]
    start = noisy[-1]
    evolution = lambda seed: model.evolution(later, key=1000 + config.seed + seed)
    forecast = lambda seed: evolution(seed)(start, fit.energy, throw=False)
    part = lambda seed: lambda: {"unlike": np.asarray(unlike_length(forecast(seed).frames, types))}
    series = np.stack([folder.part(f"seed {seed}", part(seed))["unlike"] for seed in range(config.seeds)])
    course = np.asarray(unlike_length(simulated.frames, types))
    folder.save_table("forecast", {"time": later, "true": course[used[-1] :], "mean": series.mean(axis=0)})
    figure = plot_recovery(true, values, deviations, times, course, later, series)
    folder.save_figure("adhesions", figure)
    return {
        "relative_error": dict(zip(names, values / true - 1, strict=True)),
        "error_over_deviation": dict(zip(names, (values - true) / deviations, strict=True)),
        "unlike_length": {
            "true": course[-1],
            "forecast": series[:, -1].mean(),
            "deviation": series[:, -1].std(ddof=1),
        },
        "n_frames": len(used),
        "n_events": len(movie.events),
    }


def with_noise(tissue: vx.Tissue, noise: float, rng: np.random.Generator) -> vx.Tissue:
    """A tissue with displaced vertices, by at most a fifth of their shortest edge: cells stay valid."""
    shortest = np.full(tissue.n_vertices, np.inf)
    ends = np.asarray(tissue.topology.edge_vertices)
    np.minimum.at(shortest, ends.ravel(), np.repeat(np.asarray(tissue.edge_lengths), 2))
    size = np.minimum(noise, shortest / 5)[:, None]
    return tissue.with_vertices(tissue.vertices + size * rng.normal(size=tissue.vertices.shape))


@plotting.house_style()
def plot_recovery(true: Any, values: Any, deviations: Any, *curves: Any) -> Any:
    """Fitted against true adhesions, and the unlike length of the run and of the forecasts."""
    times, course, later, series = curves
    figure, ((left, right),) = plotting.new_figure(1, 2, width=2.8)
    left.plot([0, true.max()], [0, true.max()], color=plotting.INK, ls=":", lw=0.8)
    left.errorbar(true, values, 2 * deviations, fmt="o", ms=4, color=plotting.SERIES[0], capsize=2)
    left.set(xlabel="true adhesion", ylabel="fitted, ± 2 standard errors")
    right.plot(times, course, color=plotting.INK, lw=0.9, label="run")
    right.plot(later, series.T, color=plotting.SERIES[1], lw=0.5)
    right.plot(later, series.mean(axis=0), color=plotting.SERIES[1], label="forecast, mean")
    right.set(xlabel="time", ylabel="length of unlike contacts")
    right.legend()
    return figure
