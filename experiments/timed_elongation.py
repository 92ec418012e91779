r"""Tensions in time that elongate a cluster along a prescribed course.

A free cluster of the energy E2 begins at equilibrium under equal tensions. The logit of the tension of each
edge is then a piecewise linear function of time, and the tissue moves against friction with T1 transitions.
The knots are fitted so that the aspect ratio follows a course: it rises to a peak and falls to a final value.
Constant tensions (one knot), under which the tissue only relaxes, are the comparison.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from experiments._shared import TensionRange, plot_tensions
from vertax import plotting, runs
from vertax.costs import aspect_ratio
from vertax.energies import AreaElasticity, LineTension


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: int = Field(default=12, ge=4)
    """Cells of the cluster."""
    peak: float = Field(default=2.0, gt=1)
    """Aspect ratio in the middle of the course."""
    end: float = Field(default=1.5, gt=1)
    """Aspect ratio at its end."""
    duration: float = Field(default=40.0, gt=0)
    """Duration of the course."""
    frames: int = Field(default=8, ge=3)
    """Equidistant times at which the aspect ratio is prescribed."""
    substeps: int = Field(default=2, ge=1)
    """Time steps per frame."""
    knots: int = Field(default=5, ge=2)
    """Knots of each tension in time."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    tensions: TensionRange = TensionRange()
    """Range of the tensions of edges, and stiffness of the cells."""
    fit: runs.Fitting = runs.Fitting(learning_rate=0.1, epochs=120)
    """Fit of the logits of the tensions."""
    gradient: runs.Gradient = runs.Gradient()
    """Gradients through each step."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=500)
    """Relaxation of each step."""


class Schedule(eqx.Module):
    """Tensions as functions of time; called with a time, it returns the energy."""

    logits: jax.Array
    low: float
    high: float
    stiffness: float
    duration: float

    def tensions(self, time: jax.Array) -> jax.Array:
        """The tension of each edge."""
        n_knots = len(self.logits)
        place = jnp.clip(time / self.duration, 0, 1) * (n_knots - 1)
        weights = jax.nn.relu(1 - jnp.abs(place - jnp.arange(n_knots)))
        return self.low + (self.high - self.low) * jax.nn.sigmoid(weights @ self.logits)

    def __call__(self, time: jax.Array) -> vx.AbstractEnergy:
        return AreaElasticity(self.stiffness, 1.0) + LineTension(self.tensions(time))


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """For constant and timed tensions: mean and largest distance from the course, and T1 transitions."""
    began, key, relaxation = time.perf_counter(), jax.random.key(config.seed), config.relaxation.build()
    first = vx.initialise.free_voronoi(config.n_cells, key=key, lloyd_steps=2)
    bounds = (config.tensions.low, config.tensions.high)

    def equal_tensions(n_knots: int) -> Schedule:
        logits = jnp.zeros((n_knots, first.n_edges))
        return Schedule(logits, *bounds, config.tensions.stiffness, config.duration)

    tissue = relaxation(first, equal_tensions(1)(jnp.array(0.0))).tissue
    times = config.duration * np.arange(config.frames + 1) / config.frames
    course = make_course(config, float(eqx.filter_jit(aspect_ratio)(tissue)), times)
    friction = vx.dissipations.SubstrateFriction(config.friction)
    options: Any = {"substeps": config.substeps, "relaxation": relaxation}
    evolution = vx.Evolution(friction, times, **options)
    cost = vx.costs.Frames([vx.costs.AspectRatio(jnp.asarray(ratio)) for ratio in course[1:]])
    metrics: dict[str, Any] = {}
    ratios: dict[str, np.ndarray] = {}
    for name, n_knots in (("constant", 1), ("timed", config.knots)):
        material = vx.dynamics.Material(equal_tensions(n_knots))
        levels: Any = {"response": evolution, "adjoint": config.gradient.build()}
        problem = vx.InverseProblem(tissue, material, cost, **levels)
        optimiser, epochs = config.fit.build(), config.fit.epochs
        fit = folder.fit(name, problem, optimiser, epochs, partial=True, progress=progress)
        folder.save_table(f"history_{name}", runs.history_table(fit.history))
        movie, schedule = evolution(tissue, fit.energy, throw=False), fit.energy.energy
        ratios[name] = np.asarray(eqx.filter_jit(eqx.filter_vmap(aspect_ratio))(movie.frames))
        distance = ratios[name][1:] - course[1:]
        metrics[name] = {
            "rms": np.sqrt(np.mean(distance**2)),
            "largest": np.max(np.abs(distance)),
            "num_t1": movie.num_t1,
            "converged": bool(movie.converged),
            "seconds_per_epoch": np.median(fit.history.seconds),
        }
    folder.save_table("course", {"time": times, "course": course} | ratios)
    tensions = np.stack([np.asarray(schedule.tensions(jnp.asarray(t))) for t in times])
    folder.save_array("tensions", tensions)
    panels, frames = {}, movie.trajectory
    for name, k in (("first", 1), ("middle", len(times) // 2), ("last", len(times) - 1)):
        folder.save_tissue(name, frames[k])
        panels[f"$t$ = {times[k]:g}"] = (frames[k], tensions[k])
    folder.save_figure("course", plot_course(panels, bounds, times, course, ratios))
    return metrics | {"seconds": time.perf_counter() - began}


def make_course(config: Config, start: float, times: np.ndarray) -> np.ndarray:
    """A smooth course from the start to the peak, and to the end."""
    smooth = lambda x: np.clip(x, 0, 1) ** 2 * (3 - 2 * np.clip(x, 0, 1))
    rise, fall = smooth(2 * times / config.duration), smooth(2 * times / config.duration - 1)
    return start + (config.peak - start) * rise + (config.end - config.peak) * fall


@plotting.house_style()
def plot_course(panels: Any, bounds: Any, times: np.ndarray, course: np.ndarray, ratios: Any) -> Any:
    """Tissues at three times, and the aspect ratio in time."""
    figure, (ax,) = plot_tensions(panels, bounds, [3.0])
    ax.plot(times, course, "o:", ms=3, color=plotting.INK, lw=0.8, label="asked for")
    for name, colour in series_colours(ratios).items():
        ax.plot(times, ratios[name], ".-", color=colour, label=f"{name} tensions")
    ax.set(xlabel="time", ylabel="aspect ratio")
    ax.legend()
    return figure
