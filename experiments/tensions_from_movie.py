"""Infer the tensions of a cluster that moves from several frames of a movie.

The frames are dumps of Surface Evolver, which contain their tensions, or those of a synthetic cluster that
moves with its outline fixed. Tensions are inferred from the first two frames, the first three, and so on, and
compared with the true ones; those of the first two frames also predict the later frames.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._shared import columns
from vertax import plotting, runs
from vertax.inference import pearson
from vertax.tensions import EdgeMotion

NAME = r"tension $\gamma / \bar\gamma$"


class Movie(runs.Section):
    """The frames; without files, those of a synthetic cluster."""

    paths: list[str] = Field(default_factory=list)
    """Dumps of Surface Evolver, in the order of their times."""


class Cluster(runs.Section):
    """The synthetic cluster and its movie."""

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
    """Standard deviation of the positions of points, for cells of area 1."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    movie: Movie = Movie()
    """The frames."""
    cluster: Cluster = Cluster()
    """The synthetic cluster, if there are no files."""
    substeps: int = Field(default=10, ge=1)
    """Steps of the motion between frames."""


class Frames(NamedTuple):
    """Tissues, points of their edges, times, and true tensions of the edges of the first frame."""

    tissues: list[vx.Tissue]
    chains: list[Any]
    times: list[float]
    tension: np.ndarray

    def motion(self, last: int, substeps: int) -> EdgeMotion:
        """The motion from the first frame to the last one."""
        part = slice(0, last + 1)
        return EdgeMotion(self.tissues[part], self.chains[part], self.times[part], substeps=substeps)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Correlation, errors, standard deviations and coverage of tensions from two frames and from all."""
    del progress
    frames = read_frames(config.movie.paths) if config.movie.paths else synthetic_frames(config)
    last = len(frames.times) - 1
    if last < 1:
        raise ValueError("movie.paths must name two frames or more.")
    inferred = [frames.motion(end, config.substeps).tensions() for end in range(1, last + 1)]
    first, last_fit = inferred[0].motion, inferred[-1].motion
    assert first is not None
    assert last_fit is not None
    inner = np.isfinite(inferred[0].tensions)
    true = frames.tension / frames.tension[inner].mean()
    rows = [compare(each, true, inner) for each in inferred]
    table = columns(rows)
    folder.save_table("frames", {"frames_used": np.arange(2, last + 2), **table})
    edges = {"true_tension": true[inner]}
    for number, each in ((2, inferred[0]), (last + 1, inferred[-1])):
        edges[f"tension_{number}_frames"] = each.tensions[inner]
        edges[f"deviation_{number}_frames"] = each.tension_deviations[inner]
    folder.save_table("edges", edges)
    # The prediction of the first two frames for all later ones.
    tension = np.where(inner, inferred[0].tensions * first.mobility, 0)
    residuals = frames.motion(last, config.substeps).residuals(tension)
    course = {"time": np.array(frames.times[1:]), "moved": last_fit.moved}
    course |= {"misfit_all_frames": last_fit.misfit}
    free = np.maximum(np.count_nonzero(residuals.any(axis=2), axis=1), 1)
    course |= {"misfit_2_frames": np.sqrt(np.sum(residuals**2, axis=(1, 2)) / free)}
    folder.save_table("misfit", course)
    folder.save_figure("tensions", plot_tensions(frames.tissues[0], true, inferred[0]))
    folder.save_figure("frames", plot_frames(table, course))
    metrics = {f"{name}_2_frames": value for name, value in rows[0].items()}
    metrics |= {f"{name}_all_frames": value for name, value in rows[-1].items()}
    return metrics | {"n_frames": last + 1, "n_edges": int(inner.sum())}


def compare(inferred: Any, true: np.ndarray, inner: np.ndarray) -> dict[str, float]:
    """Errors of the tensions of inner edges."""
    tension, deviation, true = inferred.tensions[inner], inferred.tension_deviations[inner], true[inner]
    error = np.abs(tension - true)
    return {
        "pearson": float(pearson(true, tension)),
        "relative_error": float(np.mean(error / true)),
        "deviation_median": float(np.median(deviation)),
        "covered": float(np.mean(error < 2 * deviation)),
        "mobility": inferred.motion.mobility,
    }


def read_frames(paths: list[str]) -> Frames:
    """The frames of dumps of Surface Evolver."""
    foams = [vx.io.read_surface_evolver(path) for path in paths]
    tissues, times = [foam.tissue for foam in foams], [foam.time for foam in foams]
    return Frames(tissues, [foam.chains for foam in foams], times, np.asarray(foams[0].tensions))


def synthetic_frames(config: Config) -> Frames:
    """The movie of a cluster of straight edges, with fixed outline and noisy points."""
    options = config.cluster
    shape_key, tension_key = jax.random.split(jax.random.key(config.seed))
    cluster = vx.initialise.free_voronoi(options.n_cells, key=shape_key, lloyd_steps=3)
    tension = np.ones(cluster.n_edges)
    if options.deviation:
        limit = 0.5 / options.deviation  # tensions between 0.5 and 1.5
        noise = jax.random.truncated_normal(tension_key, -limit, limit, (cluster.n_edges,))
        tension = np.asarray(1 + options.deviation * noise)
    chains = [list(np.asarray(cluster.edge_points(jnp.linspace(0, 1, options.pieces + 1))))]
    times = (options.interval * np.arange(options.frames)).tolist()
    for k in range(1, options.frames):
        steps = k * config.substeps
        motion = EdgeMotion([cluster] * 2, [chains[0]] * 2, [0, times[k]], substeps=steps)
        chains += motion.predicted(tension)
    rng = np.random.default_rng(config.seed)
    noisy = [[c + options.noise * rng.normal(size=c.shape) for c in frame] for frame in chains]
    return Frames([cluster] * options.frames, noisy, times, tension)


@plotting.house_style()
def plot_tensions(tissue: vx.Tissue, true: np.ndarray, inferred: Any) -> Any:
    """The cluster with the tensions of its inner edges from two frames, and those against the true ones."""
    figure, ((left, right),) = plotting.new_figure(1, 2, width=3.3, height=2.9)
    vx.plot_tissue(tissue, None, inferred.tensions, ax=left, edge_label=NAME)
    left.set_title("from the first two frames")
    inner = np.isfinite(inferred.tensions)
    options: Any = {"deviation": inferred.tension_deviations[inner], "ax": right, "name": NAME}
    plotting.plot_recovery(true[inner], inferred.tensions[inner], **options)
    return figure


@plotting.house_style()
def plot_frames(table: dict[str, Any], course: dict[str, Any]) -> Any:
    """Errors by number of frames, and misfits by time."""
    figure, ((left, right),) = plotting.new_figure(1, 2, width=2.9, height=2.5)
    number = np.arange(2, 2 + len(table["relative_error"]))
    left.semilogy(number, 100 * table["relative_error"], "o-", label="mean relative error")
    left.semilogy(number, 100 * table["deviation_median"], "s--", label="median deviation")
    left.set(xlabel="frames used", ylabel="percent", xticks=number)
    left.legend()
    right.semilogy(course["time"], course["moved"], "o-", label="points moved")
    right.semilogy(course["time"], course["misfit_2_frames"], "s--", label="misfit, two frames")
    right.semilogy(course["time"], course["misfit_all_frames"], "^:", label="misfit, all frames")
    right.set(xlabel="time", ylabel="root mean square")
    right.legend()
    return figure
