"""Choose target shape factors of cells that give the tissue a mean shape factor (paper, Figure 4a).

A periodic tissue of the energy E1 starts from random target shape factors. They are adjusted until the
mean of the shape factors that the cells have in equilibrium is the one asked for.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from vertax.costs import MeanShapeFactor
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem, Record, limits
from vertax.initialise import periodic_voronoi
from vertax.mesh import Tissue
from vertax.plotting import plot_history
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Gradient,
    Relaxation,
    RunFolder,
    ShapeFactors,
    TissueSection,
    fit_metrics,
    history_columns,
)

from . import figures


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    target: float = Field(default=4.10, gt=0)
    """The mean shape factor to reach."""
    accuracy: float = Field(default=1e-3, gt=0)
    """Distance from the target that counts as reached."""
    tissue: TissueSection = TissueSection()
    """The tissue."""
    start: ShapeFactors = ShapeFactors(mean=3.91, deviation=0.1)
    """Distribution of the target shape factors to begin with."""
    gradient: Gradient = Gradient()
    """How gradients are taken."""
    fit: Fitting = Fitting(learning_rate=2e-3)
    """How the parameters are fitted."""
    relaxation: Relaxation = Relaxation()
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: mean shape factor in equilibrium and of the parameters, at the start and at
    the end, and the epoch at which the target was reached.

    **Raises:**

    - `FitError` if the fit cannot go on.
    """
    keys = jax.random.split(jax.random.key(config.seed))
    n_cells = config.tissue.n_cells
    noise = jax.random.normal(keys[0], (n_cells,))
    # The sample, and not only its distribution, has the mean to start from.
    noise = noise - jnp.mean(noise)
    energy = ShapeFactorEnergy(config.start.mean + config.start.deviation * noise)
    drawn = periodic_voronoi(n_cells, key=keys[1], lloyd_steps=config.tissue.lloyd_steps)
    response = config.relaxation.build()
    problem = InverseProblem(
        drawn,
        energy,
        MeanShapeFactor(config.target),
        adjoint=config.gradient.build(),
        response=response,
    )
    optimiser, epochs = config.fit.build(), config.fit.epochs
    outcome = folder.fit("design", problem, optimiser, epochs, callback=_notes, progress=progress)
    initial = response(drawn, energy, throw=False).tissue
    observed, targets = outcome.notes["observed"], outcome.notes["targets"]
    _save(initial, outcome, observed, targets, config, folder)
    mean, of_parameters = observed.mean(axis=1), targets.mean(axis=1)
    off = np.abs(mean - config.target)
    best, near = int(outcome.best_epoch), off <= config.accuracy
    return {
        "target": config.target,
        "mean_initial": mean[0],
        "mean_final": mean[best],
        "distance_final": off[best],
        "mean_parameter_initial": of_parameters[0],
        "mean_parameter_final": of_parameters[best],
        "mismatch_of_cells_final": np.abs(observed - targets)[best].mean(),
        "reached_at_epoch": int(np.argmax(near)) if near.any() else None,
        **fit_metrics(outcome),
        "gradient_residual": np.nanmax(outcome.history.gradient_residual),
        "seconds": outcome.history.seconds.sum(),
        "limited_by": limits(outcome, np.asarray(near[best])),
    }


def _notes(epoch: int, record: Record) -> dict[str, jax.Array]:
    targets = record.parameters.target_shape_factor
    return {"observed": record.tissue.shape_factors, "targets": targets}


def _save(
    initial: Tissue,
    outcome: Fit,
    observed: np.ndarray,
    targets: np.ndarray,
    config: Config,
    folder: RunFolder,
) -> None:
    best = int(outcome.best_epoch)
    folder.save_tissue("initial", initial)
    folder.save_tissue("designed", outcome.tissue)
    means = {"mean_observed": observed.mean(axis=1), "mean_parameter": targets.mean(axis=1)}
    folder.save_table("history", history_columns(outcome.history) | means)
    cells = np.arange(targets.shape[1])
    columns = {"cell": cells, "target_initial": targets[0], "target_final": targets[best]}
    columns |= {"observed_initial": observed[0], "observed_final": observed[best]}
    folder.save_table("cells", columns)
    epochs, cell = (x.ravel() for x in np.indices(targets.shape))
    every = {"epoch": epochs, "cell": cell, "target": targets.ravel(), "observed": observed.ravel()}
    folder.save_table("cells_by_epoch", every)
    panels = {"initial": (initial, observed[0]), "designed": (outcome.tissue, observed[best])}
    figure = figures.mechanics(panels, observed, targets, config.target)
    folder.save_figure("design", figure)
    convergence = Figure()
    plot_history(outcome.history, figure=convergence)
    folder.save_figure("convergence", convergence)
