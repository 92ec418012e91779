"""Choose tensions of edges that elongate a cluster of cells (paper, Figure 4b).

Free clusters of the energy E2, of several sizes, get a tension for each edge. From random ones they are
first brought to one aspect ratio, where all designs start; then the tensions are adjusted until the
cluster has the aspect ratio asked for. Cells change neighbours on the way.

With `measure = "box"` tissues are periodic, and it is their box that comes to rest, at a fixed area and
without shear stress, and is to be elongated.
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field

from vertax.costs import AspectRatio, aspect_ratio
from vertax.fitting import Fit, InverseProblem, Record, limits, member
from vertax.inference import foam_terms
from vertax.initialise import free_voronoi, periodic_voronoi
from vertax.mechanics import BoxRelaxation
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Gradient,
    Relaxation,
    RunFolder,
    TensionRange,
    fit_side_by_side,
    histories,
    joined,
    replicate_keys,
    spread_of,
)

from . import figures


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: list[int] = Field(default=[6, 12, 18], min_length=1)
    """Sizes of the clusters."""
    targets: list[float] = Field(default=[1.75, 2.0, 2.25, 2.5, 2.75, 3.0], min_length=1)
    """Aspect ratios to reach."""
    start_ratio: float = Field(default=1.5, gt=1)
    """Aspect ratio at which all designs start."""
    measure: Literal["moments", "farthest", "box"] = "moments"
    """How the ratio is measured: second moments of the area, or the paper's farthest vertices; or the
    sides of the box of a periodic tissue."""
    accuracy: float = Field(default=1e-2, gt=0)
    """Distance from the target that counts as reached."""
    replicates: int = Field(default=5, ge=1)
    """Independent clusters of each size."""
    shown: int = Field(default=12, ge=2)
    """Size of the cluster in the figure."""
    shown_target: float = Field(default=2.75, gt=1)
    """Its target; the nearest one is taken, of sizes too."""
    tensions: TensionRange = TensionRange()
    """Tensions of the edges and stiffness of the cells."""
    spread: float = Field(default=0.5, ge=0, lt=1)
    """Share of the range of tensions that the first ones are drawn from."""
    gradient: Gradient = Gradient()
    """How gradients are taken."""
    start: Fitting = Fitting(learning_rate=0.1, epochs=60)
    """How the aspect ratio to start at is reached."""
    fit: Fitting = Fitting(learning_rate=0.1, epochs=200)
    """How the tensions (their logits) are fitted."""
    relaxation: Relaxation = Relaxation(max_steps=300)
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics of each size of cluster: for each target mean and standard deviation of the
    squared error, worst ratio, T1 transitions, largest force, and what limits those that fell short.

    **Raises:**

    - `FitError` if a fit cannot go on.
    """
    metrics: dict[str, Any] = {}
    designs: dict[int, tuple[Fit, Fit]] = {}
    tables: list[dict[str, Any]] = []
    for n_cells in config.n_cells:
        designs[n_cells] = started, outcome = _design(config, n_cells, folder, progress)
        labels = [
            {"n_cells": str(n_cells), "target": str(target), "replicate": str(k)}
            for target, k in _members(config)
        ]
        table = histories(outcome, labels)
        tables.append(table | {"aspect_ratio": outcome.notes["ratio"].T.ravel()})
        metrics[f"{n_cells} cells"] = _metrics(config, started, outcome)
        folder.save_table("history", joined(tables))
    _save(config, designs, folder)
    return metrics


def _members(config: Config) -> list[tuple[float, int]]:
    """Target and replicate of each member of a batch."""
    return [(target, k) for target in config.targets for k in range(config.replicates)]


def _design(config: Config, n_cells: int, folder: RunFolder, progress: bool) -> tuple[Fit, Fit]:
    """The fits to the ratio at which designs start, and to the targets."""
    problems = []
    response, make = config.relaxation.build(), free_voronoi
    if config.measure == "box":
        response, make = BoxRelaxation(free="shape", relaxation=response), periodic_voronoi
    for key in replicate_keys(config.seed, config.replicates):
        cluster = make(n_cells, key=key, lloyd_steps=2)
        problems.append(
            InverseProblem(
                cluster,
                config.tensions.draw(cluster, config.spread, key),
                AspectRatio(jnp.array(config.start_ratio), config.measure),
                adjoint=config.gradient.build(),
                response=response,
            )
        )
    options: dict[str, Any] = {"notes": _ratio, "progress": progress}
    name = f"{n_cells} cells"
    started = fit_side_by_side(folder, f"{name} first", problems, config.start, **options)
    bound = []
    for target, k in _members(config):
        tissue, energy = member((started.tissue, started.energy), k)
        replaced = (tissue, energy, AspectRatio(jnp.array(target), config.measure))
        bound.append(eqx.tree_at(lambda p: (p.tissue, p.energy, p.cost), problems[k], replaced))
    return started, fit_side_by_side(folder, name, bound, config.fit, **options)


_aspect_ratio = eqx.filter_jit(aspect_ratio)


def _ratio(problem: InverseProblem, record: Record) -> dict[str, Array]:
    assert isinstance(problem.cost, AspectRatio)
    return {"ratio": _aspect_ratio(record.tissue, problem.cost.measure)}


def _ratios(config: Config, outcome: Fit) -> np.ndarray:
    """Aspect ratios of the best designs, shape `(targets, replicates)`, or `(1, replicates)` at the start."""
    measured = eqx.filter_vmap(lambda tissue: aspect_ratio(tissue, config.measure))
    ratios = np.asarray(eqx.filter_jit(measured)(outcome.tissue), float)
    return ratios.reshape(-1, config.replicates)


def _metrics(config: Config, started: Fit, outcome: Fit) -> dict[str, Any]:
    by_target = lambda x: np.asarray(x).reshape(len(config.targets), config.replicates)
    ratios = _ratios(config, outcome)
    squared = (ratios - np.array(config.targets)[:, None]) ** 2
    verdicts = by_target(limits(outcome, (squared <= config.accuracy**2).ravel()))
    history = outcome.history
    return {
        "start_ratio": spread_of(_ratios(config, started)),
        "squared_error_mean": squared.mean(),
        "squared_error_max": squared.max(),
        "reached_fraction": np.mean(verdicts == "reached"),
        "max_force": np.max(outcome.max_force),
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.nanmax(history.gradient_residual),
        "seconds": history.seconds.sum() + started.history.seconds.sum(),
        "seconds_per_epoch": np.median(history.seconds),
        "targets": {
            str(target): {
                "squared_error": spread_of(squared[k]),
                "ratios": ratios[k],
                "num_t1": by_target(history.num_t1.sum(axis=0))[k],
                "best_epoch": by_target(outcome.best_epoch)[k],
                "limited_by": verdicts[k].tolist(),
            }
            for k, target in enumerate(config.targets)
        },
    }


def _save(config: Config, designs: dict[int, tuple[Fit, Fit]], folder: RunFolder) -> None:
    ratios = {n_cells: _ratios(config, outcome) for n_cells, (_, outcome) in designs.items()}
    rows = [
        (n_cells, target, k, values[i, k])
        for n_cells, values in ratios.items()
        for i, target in enumerate(config.targets)
        for k in range(config.replicates)
    ]
    names = ("n_cells", "target", "replicate", "aspect_ratio")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    error = (np.array(columns["aspect_ratio"]) - np.array(columns["target"])) ** 2
    folder.save_table("aspect_ratios", columns | {"squared_error": error})
    n_cells = min(designs, key=lambda n: abs(n - config.shown))
    index = int(np.argmin(np.abs(np.array(config.targets) - config.shown_target)))
    started, outcome = designs[n_cells]
    panels = {}
    for name, fitted, row in (("initial", started, 0), ("designed", outcome, index)):
        # The first replicate.
        own = member((fitted.tissue, fitted.energy), row * config.replicates)
        ratio = _ratios(config, fitted)[row, 0]
        panels[f"{name}: $r$ = {ratio:.2f}"] = (own[0], np.asarray(foam_terms(own[1])[1].tension))
        folder.save_tissue(name, own[0])
    bounds = (config.tensions.low, config.tensions.high)
    figure = figures.elongation(panels, bounds, np.array(config.targets), ratios)
    folder.save_figure("design", figure)
