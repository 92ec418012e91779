r"""Diffusion of self-propelled cells against their target shape factor and speed.

Each cell pushes in a direction that diffuses, and cells change neighbours. The mean squared displacement of
cells, without that of the tissue, gives at late times the diffusion coefficient $D_\mathrm{eff} = \lim
\langle \Delta r^2 \rangle / 4 t$, in units of that of a free cell, $v_0^2 / 2 D_r$. It vanishes in a solid,
and the target shape factor of the transition decreases with the speed (Bi et al. 2016,
doi:10.1103/PhysRevX.6.021011; their Voronoi tissues, with $10^{-3}$ between glass and fluid, agree in kind
only).
"""

import time
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from experiments._shared import replicate_keys
from vertax import plotting, runs


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    shape_factors: list[float] = Field(default=[3.3, 3.5, 3.65, 3.8, 3.95], min_length=2)
    """Target shape factors of all cells."""
    speeds: list[float] = Field(default=[0.2, 0.6, 1.2], min_length=1)
    """Speeds $v_0$ of a cell without neighbours; a cell has two vertices, so its force is $2 \\zeta v_0$."""
    rotational_diffusion: float = Field(default=1.0, gt=0)
    """$D_r$, the inverse persistence time of a direction."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    duration: float = Field(default=60.0, gt=0)
    """Duration of the measurement; a quarter of it precedes it."""
    interval: float = Field(default=0.5, gt=0)
    """Time between frames."""
    substeps: int = Field(default=5, ge=1)
    """Steps per frame."""
    replicates: int = Field(default=1, ge=1)
    """Independent tissues for each pair of shape factor and speed."""
    threshold: float = Field(default=1e-3, gt=0)
    """Smallest diffusion, relative to that of a free cell, of a fluid tissue."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=36)
    """The tissues."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(tolerance=1e-6, max_steps=500)
    """Relaxation of each step."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Relative diffusion, rates of transitions, onsets of diffusion, and the fraction of valid frames."""
    began, shape = time.perf_counter(), (len(config.speeds), len(config.shape_factors), config.replicates)
    tasks = {
        f"v0 {speed:g} p0 {p0:g} tissue {k}": (speed, p0, k)
        for speed in config.speeds
        for p0 in config.shape_factors
        for k in range(config.replicates)
    }
    results = [*folder.map_parts(partial(measure, config), tasks, progress=progress, unit="run").values()]
    join = lambda name: np.stack([r[name] for r in results]).reshape(*shape, *results[0][name].shape)
    squared, rate, valid = np.nanmean(join("squared"), axis=2), join("t1_rate"), join("converged")
    rate = np.nanmean(rate, axis=2) / config.tissue.n_cells
    lags = config.interval * np.arange(1, squared.shape[-1] + 1)
    free = np.asarray(config.speeds)[:, None] ** 2 / (2 * config.rotational_diffusion)
    diffusion = late_slope(lags, squared) / 4 / free
    speeds, p0 = np.meshgrid(config.speeds, config.shape_factors, indexing="ij")
    table = {
        "speed": speeds,
        "p0": p0,
        "diffusion": diffusion,
        "t1_rate": rate,
        "converged": valid.mean(axis=2),
    }
    folder.save_table("diffusion", {name: values.ravel() for name, values in table.items()})
    folder.save_array("squared_displacements", squared)
    folder.save_figure("diffusion", plot_diffusion(config, lags, squared, diffusion, rate))
    return {
        "diffusion": diffusion.tolist(),
        "t1_rate": rate.tolist(),
        "fluid_from": [onset(config, values) for values in diffusion],
        "converged_fraction": float(valid.mean()),
        "seconds": time.perf_counter() - began,
    }


def measure(config: Config, task: tuple[float, float, int]) -> dict[str, np.ndarray]:
    """Mean squared displacements, rate of transitions, and the fraction of frames before a step failed."""
    speed, p0, replicate = task
    first, noise = jax.random.split(replicate_keys(config.seed, config.replicates)[replicate])
    tissue = vx.initialise.periodic_voronoi(key=first, **config.tissue.model_dump())
    n_frames = max(round(config.duration / config.interval), 4)
    start = max(n_frames // 4, 1)
    times, friction = config.interval * np.arange(start + n_frames + 1), config.friction
    activity = vx.activities.SelfPropulsion(2 * friction * speed, config.rotational_diffusion)
    options: Any = {"activity": activity, "key": noise, "substeps": config.substeps}
    options |= {"relaxation": config.relaxation.build()}
    evolution = vx.Evolution(vx.dissipations.SubstrateFriction(friction), times, **options)
    movie = evolution(tissue, vx.energies.ShapeFactorEnergy(jnp.asarray(p0)), throw=False)
    # Frames after a step that did not converge are not valid.
    n_valid = int(np.sum(movie.results == vx.RESULTS.successful))
    places = np.asarray(unwrapped_centroids(movie.frames))[start:n_valid]
    count = max(n_valid - 1 - start, 0)
    transitions = float(movie.transitions[start + 1 : n_valid].sum())
    squared = np.full(n_frames // 2, np.nan)
    for k in range(1, min(len(places), n_frames // 2 + 1)):
        squared[k - 1] = np.mean(np.sum((places[k:] - places[:-k]) ** 2, axis=-1))
    rate = transitions / (count * config.interval) if count else np.nan
    return {"squared": squared, "t1_rate": np.asarray(rate), "converged": np.asarray(count / n_frames)}


@eqx.filter_jit
def unwrapped_centroids(frames: vx.Tissue) -> jax.Array:
    """Centroids of cells across the borders of the box, without the motion of their mean."""
    centroids = eqx.filter_vmap(lambda frame: frame.centroids)(frames)
    boundary = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, frames.boundary)
    steps = boundary.shortest(jnp.diff(centroids, axis=0))
    steps = steps - steps.mean(axis=1, keepdims=True)
    return jnp.concatenate([jnp.zeros_like(centroids[:1]), jnp.cumsum(steps, axis=0)])


def late_slope(lags: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """Slopes of mean squared displacements over the second half of the lags, without NaN."""
    late = np.where(lags > lags[-1] / 2, squared, np.nan)
    valid = np.isfinite(late)
    count = np.maximum(valid.sum(axis=-1, keepdims=True), 1)
    x = np.where(valid, lags - np.sum(valid * lags, axis=-1, keepdims=True) / count, 0)
    size = np.sum(x**2, axis=-1)
    return np.sum(x * np.where(valid, late, 0), axis=-1) / np.where(size > 0, size, np.nan)


def onset(config: Config, diffusion: np.ndarray) -> float | None:
    """The shape factor above which all tissues are fluid."""
    solid = np.flatnonzero(~(diffusion > config.threshold))
    index = 0 if solid.size == 0 else solid[-1] + 1
    return None if index == len(diffusion) else config.shape_factors[index]


@plotting.house_style()
def plot_diffusion(config: Config, lags: Any, squared: Any, coefficients: Any, rate: Any) -> Any:
    """Mean squared displacements, diffusion (at least a tenth of the threshold) and transitions."""
    figure, ((left, middle, right),) = plotting.new_figure(1, 3, width=2.5)
    k = len(config.speeds) // 2
    shades = series_colours(f"{p0:g}" for p0 in config.shape_factors)
    for (name, colour), values in zip(shades.items(), squared[k], strict=True):
        left.plot(lags, values, color=colour, label=f"$p_0 = {name}$")
    # A persistent random walk: Bi et al. 2016, eq. 8.
    turn, speed = config.rotational_diffusion, config.speeds[k]
    free = 2 * (speed / turn) ** 2 * (turn * lags + np.expm1(-turn * lags))
    left.plot(lags, free, "--", color=plotting.INK, lw=0.8, label="free cell")
    left.set(xscale="log", yscale="log", xlabel="time", title=f"$v_0 = {speed:g}$")
    left.set(ylabel="mean squared displacement", ylim=(0.1 * np.nanmin(squared[k]), None))
    left.legend(fontsize=6, ncol=2, loc="lower right")
    for i, speed in enumerate(config.speeds):
        colour = plotting.SERIES[i % len(plotting.SERIES)]
        style: Any = {"color": colour, "ms": 3, "label": f"$v_0 = {speed:g}$"}
        shown = np.maximum(coefficients[i], 0.1 * config.threshold)
        middle.plot(config.shape_factors, shown, "o-", **style)
        right.plot(config.shape_factors, rate[i], "o-", **style)
    middle.axhline(config.threshold, color=plotting.INK, lw=0.7, ls=":")
    middle.set(yscale="log", xlabel="$p_0$", ylabel="$D_\\mathrm{eff}$ / that of a free cell")
    right.set(xlabel="$p_0$", ylabel="T1s per cell and time")
    right.legend()
    return figure
