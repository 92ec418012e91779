"""Tensions of a cluster on its way, from how the points of its edges move.

The frames are dumps of Surface Evolver, which know their tensions, or those of a synthetic cluster that is
let go while its outline is held. Tensions are inferred from the first two frames, the first three, and so on,
and compared with the true ones; and those of the first two predict the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field

from vertax.inference import EdgeMotion, MovingTensions, pearson
from vertax.initialise import free_voronoi
from vertax.io import read_surface_evolver
from vertax.mesh import Tissue
from vertax.runs import ExperimentConfig, RunFolder, Section

from . import figures


class Movie(Section):
    """The frames; without files, those of a synthetic cluster."""

    paths: list[str] = Field(default_factory=list)
    """Dumps of Surface Evolver, in the order of their times."""


class Cluster(Section):
    """The synthetic cluster, and its movie."""

    n_cells: int = Field(default=12, ge=4)
    """Number of cells."""
    deviation: float = Field(default=0.2, ge=0, lt=0.5)
    """Standard deviation of the tensions, of mean 1."""
    pieces: int = Field(default=8, ge=2)
    """Pieces of each edge."""
    frames: int = Field(default=4, ge=2)
    """Number of frames."""
    interval: float = Field(default=0.02, gt=0)
    """Time between frames, in units of friction times length over tension."""
    noise: float = Field(default=1e-4, ge=0)
    """Standard deviation of the positions of points, in cells of area 1."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    movie: Movie = Movie()
    """The frames."""
    cluster: Cluster = Cluster()
    """What is drawn if there are none."""
    substeps: int = Field(default=50, ge=1)
    """Steps of the motion from one frame to the next."""


class Frames(NamedTuple):
    """A movie, and what its edges really do."""

    tissues: Sequence[Tissue]
    chains: Sequence[Sequence[Float[np.ndarray, "_ 2"]]]
    times: Sequence[float]
    tension: Float[np.ndarray, " edges"]
    """Of the edges of the first frame."""

    def motion(self, first: int, last: int, substeps: int) -> EdgeMotion:
        """From one frame to another one."""
        part = slice(first, last + 1)
        return EdgeMotion(
            self.tissues[part], self.chains[part], self.times[part], substeps=substeps
        )


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: correlation, mean relative error, standard deviations and the share of tensions
    within two of them, for the first two frames and for all; how far points went and how far they are from
    what the tensions say.

    **Raises:**

    - `FileNotFoundError` and `ValueError` for files that cannot be used.
    """
    frames = _read(config.movie.paths) if config.movie.paths else _drawn(config)
    last = len(frames.times) - 1
    if last < 1:
        raise ValueError("movie.paths must name two frames or more.")
    found = [frames.motion(0, end, config.substeps).tensions() for end in range(1, last + 1)]
    inner = np.isfinite(found[0].tension)
    true = frames.tension / frames.tension[inner].mean()
    rows = [_compared(one, true, inner) for one in found]
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    folder.save_table("frames", {"frames_used": np.arange(2, last + 2), **table})
    edges = {"true_tension": true[inner]}
    for number, one in ((2, found[0]), (last + 1, found[-1])):
        edges[f"tension_{number}_frames"] = one.tension[inner]
        edges[f"deviation_{number}_frames"] = one.deviation[inner]
    folder.save_table("edges", edges)
    # What the first two frames say of all later ones.
    whole = frames.motion(0, last, config.substeps)
    known = np.where(inner, found[0].tension * found[0].mobility, 0)
    predicted = np.sqrt(2 * np.mean(whole.residuals(known) ** 2, axis=1))
    course = {
        "time": np.array(frames.times[1:]),
        "moved": found[-1].moved,
        "misfit_all_frames": found[-1].misfit,
        "misfit_2_frames": predicted,
    }
    folder.save_table("misfit", course)
    tissue = frames.tissues[0]
    folder.save_figure("tensions", figures.tensions(tissue, true, found[0]))
    folder.save_figure("frames", figures.frames(table, course))
    metrics = {f"{name}_2_frames": value for name, value in rows[0].items()}
    metrics |= {f"{name}_all_frames": value for name, value in rows[-1].items()}
    return metrics | {"n_frames": last + 1, "n_edges": int(inner.sum())}


def _compared(
    found: MovingTensions, true: Float[np.ndarray, " edges"], inner: Any
) -> dict[str, float]:
    tension, deviation, true = found.tension[inner], found.deviation[inner], true[inner]
    error = np.abs(tension - true)
    return {
        "pearson": float(pearson(true, tension)),
        "relative_error": float(np.mean(error / true)),
        "deviation_median": float(np.median(deviation)),
        "covered": float(np.mean(error < 2 * deviation)),
        "mobility": found.mobility,
    }


def _read(paths: Sequence[str]) -> Frames:
    foams = [read_surface_evolver(path) for path in paths]
    return Frames(
        [foam.tissue for foam in foams],
        [foam.chains for foam in foams],
        [foam.time for foam in foams],
        np.asarray(foams[0].tensions),
    )


def _drawn(config: Config) -> Frames:
    """A cluster of straight edges that is let go, with its outline held."""
    options = config.cluster
    shape_key, tension_key = jax.random.split(jax.random.key(config.seed))
    cluster = free_voronoi(options.n_cells, key=shape_key, lloyd_steps=3)
    spread = options.deviation * jax.random.truncated_normal(
        tension_key, -0.5 / options.deviation, 0.5 / options.deviation, (cluster.n_edges,)
    )
    tension = np.asarray(1 + spread if options.deviation else jnp.ones(cluster.n_edges))
    fractions = jnp.linspace(0, 1, options.pieces + 1)
    chains = [list(np.asarray(cluster.edge_points(fractions)))]
    times = options.interval * np.arange(options.frames)
    for number in range(1, options.frames):
        held = EdgeMotion(
            [cluster] * 2, [chains[0]] * 2, [0, times[number]], substeps=number * config.substeps
        )
        chains += held.predicted(tension)
    rng = np.random.default_rng(config.seed)
    blurred = [[c + options.noise * rng.normal(size=c.shape) for c in frame] for frame in chains]
    return Frames([cluster] * options.frames, blurred, times.tolist(), tension)
