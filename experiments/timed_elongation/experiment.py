r"""Inverse design in time: tensions that take the aspect ratio of a cluster along a prescribed course.

A free cluster of the energy E2 begins at rest, under equal tensions. From then on each edge has a tension
that changes in time, linearly (in its logit) from knot to knot, and the tissue follows against friction,
through T1 transitions. The knots are adjusted until the aspect ratio is at each time what the course asks
for: it rises to a peak and falls again to where it stays. With a single knot, tensions that do not
change, the tissue can only relax; what that reaches is shown beside.
"""

from __future__ import annotations

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from vertax.costs import AspectRatio, Frames, aspect_ratio
from vertax.dissipations import SubstrateFriction
from vertax.dynamics import Evolution, Evolved, Material
from vertax.energies import AbstractEnergy, AreaElasticity, LineTension
from vertax.fitting import InverseProblem
from vertax.initialise import free_voronoi
from vertax.mesh import Tissue
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Gradient,
    Relaxation,
    RunFolder,
    TensionRange,
    history_columns,
)

from . import figures


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: int = Field(default=12, ge=4)
    """Cells of the cluster."""
    peak: float = Field(default=2.0, gt=1)
    """Aspect ratio in the middle of the course."""
    end: float = Field(default=1.5, gt=1)
    """Aspect ratio at its end."""
    duration: float = Field(default=40.0, gt=0)
    """Its length in time."""
    frames: int = Field(default=8, ge=3)
    """Times, equally far apart, at which the course is asked for."""
    substeps: int = Field(default=2, ge=1)
    """Steps in time from one to the next."""
    knots: int = Field(default=5, ge=2)
    """Knots of each tension in time."""
    friction: float = Field(default=1.0, gt=0)
    """Friction of a vertex with the substrate."""
    tensions: TensionRange = TensionRange()
    """Range of the tensions of edges, and stiffness of the cells."""
    fit: Fitting = Fitting(learning_rate=0.1, epochs=120)
    """How the tensions (their logits) are fitted."""
    gradient: Gradient = Gradient()
    """How gradients through each step are taken."""
    relaxation: Relaxation = Relaxation(max_steps=500)
    """How the tissue is relaxed in each step."""


class Schedule(eqx.Module):
    """Tensions that change in time, as a function of time that returns an energy."""

    logits: Float[Array, "knots edges"]
    low: float
    high: float
    stiffness: float
    duration: float

    def tensions(self, time: Float[Array, ""]) -> Float[Array, " edges"]:
        """The tension of each edge at a time."""
        n_knots = len(self.logits)
        place = jnp.clip(time / self.duration, 0, 1) * (n_knots - 1)
        weights = jax.nn.relu(1 - jnp.abs(place - jnp.arange(n_knots)))
        return self.low + (self.high - self.low) * jax.nn.sigmoid(weights @ self.logits)

    def __call__(self, time: Float[Array, ""]) -> AbstractEnergy:
        """The energy at a time."""
        return AreaElasticity(self.stiffness, 1.0) + LineTension(self.tensions(time))


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics, for constant and for timed tensions: the root mean square and the largest
    distance from the course, and T1 transitions.

    **Raises:**

    - `FitError` if a fit cannot go on.
    """
    began = time.perf_counter()
    first = free_voronoi(config.n_cells, key=jax.random.key(config.seed), lloyd_steps=2)
    schedule = _schedule(config, first, 1)
    tissue = config.relaxation.build()(first, schedule(jnp.array(0.0))).tissue
    times = config.duration * np.arange(config.frames + 1) / config.frames
    course = _course(config, float(_ratio(tissue)), times)
    evolution = Evolution(
        SubstrateFriction(config.friction),
        times,
        substeps=config.substeps,
        relaxation=config.relaxation.build(),
    )
    cost = Frames([AspectRatio(jnp.asarray(ratio)) for ratio in course[1:]])
    metrics: dict[str, Any] = {}
    ratios: dict[str, np.ndarray] = {}
    table: dict[str, Any] = {"time": times, "course": course}
    for name, n_knots in (("constant", 1), ("timed", config.knots)):
        problem = InverseProblem(
            tissue,
            Material(_schedule(config, first, n_knots)),
            cost,
            response=evolution,
            adjoint=config.gradient.build(),
        )
        outcome = folder.fit(
            name, problem, config.fit.build(), config.fit.epochs, partial=True, progress=progress
        )
        folder.save_table(f"history_{name}", history_columns(outcome.history))
        found = outcome.energy.energy
        assert isinstance(found, Schedule)
        movie = evolution(tissue, outcome.energy, throw=False)
        table[name] = ratios[name] = np.asarray(_ratios(movie.frames))
        apart = ratios[name][1:] - course[1:]
        metrics[name] = {
            "rms": np.sqrt(np.mean(apart**2)),
            "largest": np.max(np.abs(apart)),
            "num_t1": movie.num_t1,
            "sound": bool(movie.sound[-1]),
            "seconds_per_epoch": np.median(outcome.history.seconds),
        }
    folder.save_table("course", table)
    _save(config, folder, movie, found, times, course, ratios)
    return metrics | {"seconds": time.perf_counter() - began}


def _schedule(config: Config, tissue: Tissue, n_knots: int) -> Schedule:
    """Equal tensions, in the middle of their range."""
    own = config.tensions
    logits = jnp.zeros((n_knots, tissue.n_edges))
    return Schedule(logits, own.low, own.high, own.stiffness, config.duration)


def _course(
    config: Config, begin: float, times: Float[np.ndarray, " times"]
) -> Float[np.ndarray, " times"]:
    """From where the tissue begins to the peak, and to the end, without a corner."""
    u = times / config.duration
    smooth = lambda x: np.clip(x, 0, 1) ** 2 * (3 - 2 * np.clip(x, 0, 1))
    rise, fall = smooth(2 * u), smooth(2 * u - 1)
    return begin + (config.peak - begin) * rise + (config.end - config.peak) * fall


_ratio = eqx.filter_jit(aspect_ratio)


@eqx.filter_jit
def _ratios(frames: Tissue) -> Float[Array, " times"]:
    return eqx.filter_vmap(aspect_ratio)(frames)


def _save(
    config: Config,
    folder: RunFolder,
    movie: Evolved,
    schedule: Schedule,
    times: Float[np.ndarray, " times"],
    course: Float[np.ndarray, " times"],
    ratios: dict[str, np.ndarray],
) -> None:
    tensions = np.stack([np.asarray(schedule.tensions(jnp.asarray(t))) for t in times])
    folder.save_array("tensions", tensions)
    frames = movie.trajectory
    panels = {}
    for name, number in (("first", 1), ("middle", len(times) // 2), ("last", len(times) - 1)):
        folder.save_tissue(name, frames[number])
        panels[f"$t$ = {times[number]:g}"] = (frames[number], tensions[number])
    bounds = (config.tensions.low, config.tensions.high)
    folder.save_figure("course", figures.course(panels, bounds, times, course, ratios))
