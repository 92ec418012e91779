"""Recover shape factors where the fit has to pass through T1 transitions (paper, Figure 3a-e).

The first guess relaxes into a topology that is several T1 transitions away from that of the target. A
distance of positions alone does not lead the fit through them. The structural cost compares pairs of
neighbours, and guidance adds the cost to the energy of the tissue: see [`fit`][vertax.fit].
"""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

import vertax as vx
from experiments._recovery import RecoveryWatch
from experiments._replicates import plot_band, plot_boxes, series_colours
from vertax import costs, inference, plotting, runs
from vertax.costs import mismatched_neighbours
from vertax.fitting import member, stack


class Guidance(runs.Section):
    """Strength of the cost in the energy of the tissue, by epoch."""

    strength: float = Field(default=50.0, gt=0)
    """First strength, in energy per cost and cell."""
    weakest: float = Field(default=1e-3, gt=0, lt=1)
    """Last strength relative to the first; the decay is exponential."""
    epochs: int = Field(default=200, ge=1)
    """Epochs with guidance."""

    def schedule(self, n_cells: int) -> Any:
        """The strength as a function of the epoch."""
        decay = lambda epoch: self.strength * n_cells * self.weakest ** (epoch / self.epochs)
        return lambda epoch: jnp.where(epoch < self.epochs, decay(epoch), 0.0)


class Method(runs.Section):
    """A cost, with or without guidance."""

    name: str
    """Name in tables and figures."""
    distance: Literal["vertices", "centroids"] = "vertices"
    """Positions that are compared: vertices by the cells that meet there (v2v), or centroids."""
    structure: float = Field(default=0.01, ge=0, le=1)
    """Weight of the structural cost; the distance has the rest."""
    guided: bool = False
    """Guidance by the cost."""

    def cost(self, target: vx.Tissue) -> vx.AbstractCost:
        """The cost of a distance from the target."""
        vertices, centroids = costs.VertexDistance(target, match="cells"), costs.CentroidDistance(target)
        distance = centroids if self.distance == "centroids" else vertices
        if self.structure == 0:
            return distance
        return (1 - self.structure) * distance + self.structure * costs.IndexAwareStructural(target)


METHODS = [
    Method(name="v2v", structure=0.0),
    Method(name="v2v + IAS"),
    Method(name="guided, no IAS", distance="centroids", structure=0.0, guided=True),
    Method(name="guided", distance="centroids", guided=True),
]


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    replicates: int = Field(default=5, ge=1)
    """Independent tissues, fitted as one batch."""
    least_mismatch: int = Field(default=4, ge=1)
    """Fewest pairs of neighbours in which start and target differ; each T1 changes two."""
    methods: list[Method] = METHODS
    """Ways to fit."""
    tissue: runs.TissueSection = runs.TissueSection()
    """The tissues."""
    truth: runs.ShapeFactors = runs.ShapeFactors(deviation=0.2)
    """Distribution of the true shape factors and of the guesses."""
    guidance: Guidance = Guidance()
    """Guidance of the methods that have it."""
    gradient: runs.Gradient = runs.Gradient()
    """Gradients through the equilibrium."""
    fit: runs.Fitting = runs.Fitting(epochs=350)
    """Fit of the parameters."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(tolerance=1e-8)
    """Relaxation of the tissues."""


class Curves(NamedTuple):
    """Measures of a method, of shape (epochs, replicates)."""

    relative_error: np.ndarray
    pearson: np.ndarray
    mismatched: np.ndarray


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By method: correlations, errors, mismatched neighbours, and the fraction of replicates that succeed.

    A replicate succeeds without mismatched neighbours, with Pearson above 0.999 and an error below 0.1 %.
    """
    scenes = make_scenes(config)
    batch, n_edges = stack(scenes), scenes[0].target.n_edges
    start = [mismatched_neighbours(s.initial, s.target) for s in scenes]
    metrics: dict[str, Any] = {"start": mismatch(start, n_edges)}
    curves: dict[str, Curves] = {}
    fits: dict[str, vx.Fit] = {}
    tables = []
    for method in config.methods:
        fits[method.name] = fit = fit_method(config, method, batch, folder, progress)
        notes, history = fit.notes, fit.history
        curves[method.name] = Curves(history.relative_error, notes["pearson"], notes["mismatched"])
        last = [mismatched_neighbours(member(fit.tissue, k), s.target) for k, s in enumerate(scenes)]
        metrics[method.name] = measure(batch, fit, last) | mismatch(last, n_edges)
        labels = [{"method": method.name, "replicate": str(k)} for k in range(len(scenes))]
        tables.append(runs.history_table(fit.history, *labels))
        folder.save_table("history", runs.concatenate(tables))
    true, initial = (np.asarray(e.target_shape_factor) for e in (batch.truth, batch.guess))
    replicate, cell = (index.ravel() for index in np.indices(true.shape))
    inferred = {n: np.asarray(fit.energy.target_shape_factor).ravel() for n, fit in fits.items()}
    table = {"replicate": replicate, "cell": cell, "true": true.ravel(), "initial": initial.ravel()}
    folder.save_table("shape_factors", table | inferred)
    firsts = {name: member(fit, 0) for name, fit in fits.items()}
    names = {name: "fitted_" + "".join(c if c.isalnum() else "_" for c in name) for name in fits}
    tissues = {names[name]: fit.tissue for name, fit in firsts.items()}
    for name, tissue in ({"target": scenes[0].target, "initial": scenes[0].initial} | tissues).items():
        folder.save_tissue(name, tissue)
    folder.save_figure("inference", plot_inference(curves, metrics))
    folder.save_figure("tissues", plot_tissues(scenes[0], firsts))
    return metrics


def make_scenes(config: Config) -> list[inference.Scene]:
    """Draws in which one first tissue relaxes into different topologies of start and target."""
    response, scenes = config.relaxation.build(), []
    options = config.tissue.model_dump() | config.truth.model_dump()
    options |= {"start": "first", "response": response, "target_response": response}
    for key in jax.random.split(jax.random.key(config.seed), 20 * config.replicates):
        try:
            scene = inference.shape_factor_scene(key=key, **options)
        except ValueError:  # the target does not converge
            continue
        mismatched = mismatched_neighbours(scene.initial, scene.target)
        if scene.converged and mismatched >= config.least_mismatch:
            scenes.append(scene)
        if len(scenes) == config.replicates:
            return scenes
    raise ValueError(
        f"Only {len(scenes)} of {20 * config.replicates} draws have start and target in topologies "
        f"that differ in {config.least_mismatch} neighbourships: choose a smaller least_mismatch, or "
        "a larger truth.deviation or tissue.n_cells."
    )


def fit_method(config: Config, method: Method, batch: Any, folder: runs.RunFolder, progress: bool) -> vx.Fit:
    """The fit of all replicates by one method."""
    levels: Any = {"adjoint": config.gradient.build(), "response": config.relaxation.build()}
    cost = eqx.filter_vmap(method.cost)(batch.target)
    problem = vx.InverseProblem(batch.initial, batch.guess, cost, **levels)
    guidance = config.guidance.schedule(config.tissue.n_cells) if method.guided else None
    options: dict[str, Any] = {"truth": batch.truth, "guidance": guidance, "progress": progress}
    options |= {"callback": RecoveryWatch(batch.truth, batch.target)}
    optimiser, epochs = config.fit.build(), config.fit.epochs
    return folder.fit(method.name, problem, optimiser, epochs, partial=True, batched=True, **options)


def mismatch(counts: list[int], n_edges: int) -> dict[str, Any]:
    """Metrics of the numbers of mismatched neighbours."""
    return {
        "mismatched_neighbours": counts,
        "mismatched_mean": np.mean(counts),
        "mismatched_most": max(counts),
        "topological_error": np.mean(counts) / n_edges,
    }


def measure(batch: Any, fit: vx.Fit, mismatched: list[int]) -> dict[str, Any]:
    """Metrics of a batch of fits."""
    true, inferred = (np.asarray(e.target_shape_factor) for e in (batch.truth, fit.energy))
    correlation, error = inference.pearson(true, inferred), inference.relative_error(true, inferred)
    succeeded = (np.asarray(mismatched) == 0) & (correlation > 0.999) & (error < 1e-3)
    history = fit.history
    return {
        "pearson": correlation,
        "pearson_mean": correlation.mean(),
        "pearson_least": correlation.min(),
        "relative_error": error,
        "relative_error_mean": error.mean(),
        "relative_error_most": error.max(),
        "succeeded": succeeded.mean(),
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
        "max_force": np.max(fit.max_force),
        "ms_per_epoch_of_batch": 1e3 * np.median(history.seconds),
        "seconds": history.seconds.sum(),
    }


@plotting.house_style()
def plot_inference(curves: dict[str, Curves], metrics: dict[str, Any]) -> Any:
    """Errors, correlations and mismatched neighbours by epoch, and at the end."""
    colours = series_colours(curves)
    figure, (first, last) = plotting.new_figure(2, 3, width=2.5)
    labels = ("relative error", "Pearson $r$", "mismatched neighbours")
    for k, (ax, label, log) in enumerate(zip(first, labels, (True, False, False), strict=True)):
        for name, curve in curves.items():
            style: Any = {"log": True} if log else {"extremes": True}
            plot_band(curve[k], ax, label=name, colour=colours[name], **style)
        ax.set(xlabel="epoch", ylabel=label)
    first[0].legend()
    final = lambda key: {name: np.asarray(metrics[name][key]) for name in curves}
    # A logarithmic axis shows no zero, which 1 - r is up to rounding.
    distances = {name: np.maximum(1 - r, 1e-16) for name, r in final("pearson").items()}
    plot_boxes(final("relative_error"), last[0], colours=colours, log=True)
    plot_boxes(distances, last[1], colours=colours, log=True)
    plot_boxes(final("mismatched_neighbours"), last[2], colours=colours)
    last[0].set(ylabel="relative error at the end")
    last[1].set(ylabel="1 − Pearson $r$ at the end")
    last[2].set(ylabel="mismatched at the end", ylim=(-0.5, None))
    for ax in last:
        ax.tick_params(axis="x", labelrotation=25)
    return figure


def plot_tissues(scene: inference.Scene, fits: dict[str, vx.Fit]) -> Any:
    """One replicate: the start, the fit of each method, and the target."""
    panels: dict[str, Any] = {"start": (scene.initial, scene.guess)}
    panels |= {name: (fit.tissue, fit.energy) for name, fit in fits.items()}
    panels |= {"target": (scene.target, scene.truth)}
    values = [np.asarray(energy.target_shape_factor) for _, energy in panels.values()]
    figure, tissues = Figure(), {title: tissue for title, (tissue, _) in panels.items()}
    plotting.plot_tissues(tissues, values, figure=figure, label="target shape factor $p_0$")
    return figure
