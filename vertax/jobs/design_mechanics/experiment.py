"""Choose target shape factors of cells that give the tissue a mean shape factor (paper, Figure 4a).

A periodic tissue of the energy E1 starts from random target shape factors. They are adjusted until the
mean of the shape factors that the cells have in equilibrium is the one asked for; or, in its place, the
shear modulus of the tissue or the anisotropy of its stiffness.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from vertax.costs import Anisotropy, MeanShapeFactor, ShearModulus
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem, Record, limits
from vertax.initialise import periodic_voronoi
from vertax.mechanics import shear_modulus, youngs_modulus
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

Quantity = Literal["shape_factor", "shear_modulus", "anisotropy"]
_COSTS = {
    "shape_factor": MeanShapeFactor,
    "shear_modulus": ShearModulus,
    "anisotropy": Anisotropy,
}


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    quantity: Quantity = "shape_factor"
    """What is designed: the mean shape factor, the relaxed shear modulus, or how much stiffer the tissue is
    along the x axis than across, (along - across) / (along + across). For moduli `relaxation.contacts` should
    be false, for they do not know of contacts."""
    target: float = 4.10
    """Its value to reach."""
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

    **Returns:** the metrics: what is designed, mean shape factor in equilibrium and of the parameters, at the
    start and at the end, and the epoch at which the target was reached.

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
        _COSTS[config.quantity](config.target),
        adjoint=config.gradient.build(),
        response=response,
    )
    optimiser, epochs = config.fit.build(), config.fit.epochs
    notes = partial(_notes, config.quantity)
    outcome = folder.fit("design", problem, optimiser, epochs, callback=notes, progress=progress)
    initial = response(drawn, energy, throw=False).tissue
    observed, targets = outcome.notes["observed"], outcome.notes["targets"]
    _save(initial, outcome, observed, targets, config, folder)
    mean, of_parameters = observed.mean(axis=1), targets.mean(axis=1)
    off = np.abs(outcome.notes["value"] - config.target)
    best, near = int(outcome.best_epoch), off <= config.accuracy
    return {
        "target": config.target,
        "initial": outcome.notes["value"][0],
        "final": outcome.notes["value"][best],
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


def _notes(quantity: Quantity, epoch: int, record: Record) -> dict[str, jax.Array]:
    targets = record.parameters.target_shape_factor
    value = _value(quantity, record.tissue, ShapeFactorEnergy(targets))
    return {"observed": record.tissue.shape_factors, "targets": targets, "value": value}


@eqx.filter_jit
def _value(quantity: Quantity, tissue: Tissue, energy: ShapeFactorEnergy) -> jax.Array:
    if quantity == "shape_factor":
        return jnp.mean(tissue.shape_factors)
    if quantity == "shear_modulus":
        return shear_modulus(tissue, energy, throw=False)
    along, across = (
        youngs_modulus(tissue, energy, angle=angle, throw=False) for angle in (0.0, jnp.pi / 2)
    )
    return (along - across) / (along + across)


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
    value = outcome.notes["value"]
    means = {
        config.quantity: value,
        "mean_observed": observed.mean(axis=1),
        "mean_parameter": targets.mean(axis=1),
    }
    folder.save_table("history", history_columns(outcome.history) | means)
    cells = np.arange(targets.shape[1])
    columns = {"cell": cells, "target_initial": targets[0], "target_final": targets[best]}
    columns |= {"observed_initial": observed[0], "observed_final": observed[best]}
    folder.save_table("cells", columns)
    epochs, cell = (x.ravel() for x in np.indices(targets.shape))
    every = {"epoch": epochs, "cell": cell, "target": targets.ravel(), "observed": observed.ravel()}
    folder.save_table("cells_by_epoch", every)
    panels = {"initial": (initial, observed[0]), "designed": (outcome.tissue, observed[best])}
    wanted = (config.quantity, value, config.target)
    figure = figures.mechanics(panels, observed, targets, wanted)
    folder.save_figure("design", figure)
    convergence = Figure()
    plot_history(outcome.history, figure=convergence)
    folder.save_figure("convergence", convergence)
