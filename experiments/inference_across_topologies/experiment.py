"""Recover hidden shape factors where the first guess has relaxed into another topology.

Start and target are several T1 transitions apart, so the fit has to lead the tissue through them. A
distance of positions alone does not; the structural cost (who touches whom) says where to go, and
guidance gets it there: see [`fit`][vertax.fit] (paper, "Topological cost functions unlock robust
parameter inference", Figure 3a-e).
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Int
from pydantic import Field

from vertax.costs import (
    AbstractCost,
    CentroidDistance,
    IndexAwareStructural,
    VertexDistance,
    mismatched_neighbours,
)
from vertax.fitting import Fit, InverseProblem, member, stack
from vertax.inference import RecoveryWatch, Scene, pearson, relative_error, shape_factor_scene
from vertax.mesh import Tissue
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Gradient,
    Relaxation,
    RunFolder,
    Section,
    ShapeFactors,
    TissueSection,
    histories,
    joined,
)

from . import figures


class Guidance(Section):
    """How strongly the cost pulls the tissue itself, from epoch to epoch."""

    strength: float = Field(default=50.0, gt=0)
    """At first, in energy per cost and cell."""
    weakest: float = Field(default=1e-3, gt=0, lt=1)
    """At its end, relative to the first; it falls exponentially."""
    epochs: int = Field(default=200, ge=1)
    """Epochs with guidance; the others have none."""

    def schedule(self, n_cells: int) -> Any:
        """Strength by epoch.

        **Arguments:**

        - `n_cells`: number of cells of the tissue.

        **Returns:** a function of the epoch.
        """

        def strength(epoch: Int[Array, ""]) -> ArrayLike:
            falling = self.strength * n_cells * self.weakest ** (epoch / self.epochs)
            return jnp.where(epoch < self.epochs, falling, 0.0)

        return strength


class Method(Section):
    """One way to fit."""

    name: str
    """What it is called in tables and figures."""
    distance: Literal["vertices", "centroids"] = "vertices"
    """Which positions are compared: vertices by the cells that meet there (v2v), or centroids."""
    structure: float = Field(default=0.01, ge=0, le=1)
    """Weight of the structural cost; the distance has the rest."""
    guided: bool = False
    """Whether the cost pulls the tissue."""


_METHODS = [
    Method(name="v2v", structure=0.0),
    Method(name="v2v + IAS"),
    Method(name="guided, no IAS", distance="centroids", structure=0.0, guided=True),
    Method(name="guided", distance="centroids", guided=True),
]


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    replicates: int = Field(default=5, ge=1)
    """Independent tissues; they are fitted as one batch."""
    least_mismatch: int = Field(default=4, ge=1)
    """Fewest neighbourships in which start and target differ; each T1 changes two."""
    methods: list[Method] = _METHODS
    """Ways to fit."""
    tissue: TissueSection = TissueSection()
    """The tissues."""
    truth: ShapeFactors = ShapeFactors(deviation=0.2)
    """Distribution of the hidden shape factors, and of the guesses."""
    guidance: Guidance = Guidance()
    """Of the methods that are guided."""
    gradient: Gradient = Gradient()
    """How the gradient is taken."""
    fit: Fitting = Fitting(epochs=350)
    """How the parameters are fitted."""
    relaxation: Relaxation = Relaxation(tolerance=1e-8)
    """How the tissues are relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics: for each method the Pearson correlations, relative errors and mismatched
    neighbours of all replicates, and how many succeeded (no neighbour mismatched, Pearson above
    0.999 and relative error below 0.1 %).

    **Raises:**

    - `ValueError` if too few draws have start and target in different topologies.
    """
    scenes = _scenes(config)
    batch = stack(scenes)
    interfaces = scenes[0].target.n_edges
    start = [mismatched_neighbours(s.initial, s.target) for s in scenes]
    metrics: dict[str, Any] = {"start": _summary_of_mismatch(start, interfaces)}
    curves: dict[str, figures.Curves] = {}
    fits: dict[str, Fit] = {}
    tables = []
    for method in config.methods:
        fits[method.name] = outcome = _fit(config, method, batch, folder, progress)
        curves[method.name] = figures.Curves(
            relative_error=outcome.history.relative_error,
            pearson=outcome.notes["pearson"],
            mismatched=outcome.notes["mismatched"],
        )
        final = [
            mismatched_neighbours(member(outcome.tissue, k), s.target) for k, s in enumerate(scenes)
        ]
        metrics[method.name] = _metrics(batch, outcome, final, interfaces)
        labels = [{"method": method.name, "replicate": str(k)} for k in range(len(scenes))]
        tables.append(histories(outcome, labels))
        folder.save_table("history", joined(tables))
    _save(scenes, fits, folder)
    folder.save_figure("inference", figures.inference(curves, metrics))
    firsts = {name: member(outcome, 0) for name, outcome in fits.items()}
    folder.save_figure("tissues", figures.tissues(scenes[0], firsts))
    return metrics


def _scenes(config: Config) -> list[Scene]:
    """Draws of which start and target relax, from one first tissue, into different topologies."""
    response = config.relaxation.build()
    scenes: list[Scene] = []
    for key in jax.random.split(jax.random.key(config.seed), 20 * config.replicates):
        try:
            scene = shape_factor_scene(
                key=key,
                start="first",
                response=response,
                target_response=response,
                **config.tissue.model_dump(),
                **config.truth.model_dump(),
            )
        except ValueError:  # the hidden tissue does not come to rest
            continue
        apart = mismatched_neighbours(scene.initial, scene.target)
        if scene.converged and apart >= config.least_mismatch:
            scenes.append(scene)
        if len(scenes) == config.replicates:
            return scenes
    raise ValueError(
        f"Only {len(scenes)} of {20 * config.replicates} draws have start and target in topologies "
        f"that differ in {config.least_mismatch} neighbourships: choose a smaller least_mismatch, or "
        "a larger truth.deviation or tissue.n_cells."
    )


def _cost(method: Method, target: Tissue) -> AbstractCost:
    distance: AbstractCost = (
        CentroidDistance(target)
        if method.distance == "centroids"
        else VertexDistance(target, match="cells")
    )
    if method.structure == 0:
        return distance
    structure = IndexAwareStructural(target)
    return (1 - method.structure) * distance + method.structure * structure


def _fit(config: Config, method: Method, batch: Scene, folder: RunFolder, progress: bool) -> Fit:
    cost = eqx.filter_vmap(lambda target: _cost(method, target))(batch.target)
    problem = InverseProblem(
        batch.initial,
        batch.guess,
        cost,
        adjoint=config.gradient.build(),
        response=config.relaxation.build(),
    )
    guidance = config.guidance.schedule(config.tissue.n_cells) if method.guided else None
    return folder.fit(
        method.name,
        problem,
        config.fit.build(),
        config.fit.epochs,
        partial=True,
        truth=batch.truth,
        guidance=guidance,
        batched=True,
        progress=progress,
        callback=RecoveryWatch(batch.truth, batch.target),
    )


def _summary_of_mismatch(counts: list[int], interfaces: int) -> dict[str, Any]:
    return {
        "mismatched_neighbours": counts,
        "mismatched_mean": np.mean(counts),
        "mismatched_most": max(counts),
        "topological_error": np.mean(counts) / interfaces,
    }


def _metrics(batch: Scene, outcome: Fit, final: list[int], interfaces: int) -> dict[str, Any]:
    true = np.asarray(batch.truth.target_shape_factor)
    inferred = np.asarray(outcome.energy.target_shape_factor)
    correlation, error = pearson(true, inferred), relative_error(true, inferred)
    succeeded = (np.asarray(final) == 0) & (correlation > 0.999) & (error < 1e-3)
    history = outcome.history
    return {
        **_summary_of_mismatch(final, interfaces),
        "pearson": correlation,
        "pearson_mean": correlation.mean(),
        "pearson_least": correlation.min(),
        "relative_error": error,
        "relative_error_mean": error.mean(),
        "relative_error_most": error.max(),
        "succeeded": succeeded.mean(),
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
        "max_force": np.max(outcome.max_force),
        "ms_per_epoch_of_batch": 1e3 * np.median(history.seconds),
        "seconds": history.seconds.sum(),
    }


def _save(scenes: list[Scene], fits: dict[str, Fit], folder: RunFolder) -> None:
    batch = stack(scenes)
    true, initial = (np.asarray(e.target_shape_factor) for e in (batch.truth, batch.guess))
    columns = {"replicate": np.repeat(np.arange(len(true)), true.shape[1])}
    columns |= {"cell": np.tile(np.arange(true.shape[1]), len(true))}
    columns |= {"true": true.ravel(), "initial": initial.ravel()}
    columns |= {n: np.asarray(f.energy.target_shape_factor).ravel() for n, f in fits.items()}
    folder.save_table("shape_factors", columns)
    folder.save_tissue("target", scenes[0].target)
    folder.save_tissue("initial", scenes[0].initial)
    for name, outcome in fits.items():
        ending = "".join(c if c.isalnum() else "_" for c in name)
        folder.save_tissue(f"fitted_{ending}", member(outcome.tissue, 0))
