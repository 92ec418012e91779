"""Choose target shape factors of cells that give the tissue a mean shape factor or a modulus.

A periodic tissue of the energy E1 starts from random target shape factors. They are fitted until the mean of
the shape factors at equilibrium has the target value (paper, Figure 4a); or, in its place, the shear modulus
of the tissue or the anisotropy of its stiffness.
"""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from vertax import plotting, runs
from vertax.costs import Anisotropy, MeanShapeFactor, ShearModulus
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem, Record, limits
from vertax.initialise import periodic_voronoi
from vertax.mechanics import shear_modulus, youngs_modulus
from vertax.mesh import Tissue

Quantity = Literal["shape_factor", "shear_modulus", "anisotropy"]
COSTS = {
    "shape_factor": MeanShapeFactor,
    "shear_modulus": ShearModulus,
    "anisotropy": Anisotropy,
}


class Config(runs.ExperimentConfig):
    """Configuration of this job."""

    quantity: Quantity = "shape_factor"
    """The design quantity: the mean shape factor, the relaxed shear modulus, or the anisotropy
    (along - across) / (along + across) of the stiffness with respect to the x axis. For moduli
    `relaxation.contacts` should be false, because moduli do not include forces of contacts."""
    target: float = 4.10
    """Its target value."""
    accuracy: float = Field(default=1e-3, gt=0)
    """Distance from the target that counts as reached."""
    tissue: runs.TissueSection = runs.TissueSection()
    """The tissue."""
    start: runs.ShapeFactors = runs.ShapeFactors(mean=3.91, deviation=0.1)
    """Distribution of the first target shape factors."""
    gradient: runs.Gradient = runs.Gradient()
    """Gradients through the equilibrium."""
    fit: runs.Fitting = runs.Fitting(learning_rate=2e-3)
    """Fit of the parameters."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection()
    """Relaxation of the tissue."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Design a tissue.

    **Returns:** the metrics: the design quantity, the mean shape factor at equilibrium and of the parameters,
    at the start and at the end, and the epoch at which the target was reached.

    **Raises:**

    - `FitError` if the fit fails.
    """
    keys, n_cells = jax.random.split(jax.random.key(config.seed)), config.tissue.n_cells
    noise = jax.random.normal(keys[0], (n_cells,))
    # The mean of the sample is the mean of the distribution.
    noise = noise - jnp.mean(noise)
    energy = ShapeFactorEnergy(config.start.mean + config.start.deviation * noise)
    drawn = periodic_voronoi(n_cells, key=keys[1], lloyd_steps=config.tissue.lloyd_steps)
    response, cost = config.relaxation.build(), COSTS[config.quantity](config.target)
    levels: Any = {"adjoint": config.gradient.build(), "response": response}
    problem = InverseProblem(drawn, energy, cost, **levels)
    optimiser, epochs = config.fit.build(), config.fit.epochs
    options: Any = {"callback": partial(note, config.quantity), "progress": progress}
    fit = folder.fit("design", problem, optimiser, epochs, **options)
    initial = response(drawn, energy, throw=False).tissue
    save(initial, fit, config, folder)
    values, best = fit.notes["value"], int(fit.best_epoch)
    observed, targets = fit.notes["observed"], fit.notes["targets"]
    mean, of_parameters = observed.mean(axis=1), targets.mean(axis=1)
    distance = np.abs(values - config.target)
    reached = distance <= config.accuracy
    return {
        "target": config.target,
        "initial": values[0],
        "final": values[best],
        "mean_initial": mean[0],
        "mean_final": mean[best],
        "distance_final": distance[best],
        "mean_parameter_initial": of_parameters[0],
        "mean_parameter_final": of_parameters[best],
        "mismatch_of_cells_final": np.abs(observed - targets)[best].mean(),
        "reached_at_epoch": int(np.argmax(reached)) if reached.any() else None,
        **runs.fit_metrics(fit),
        "gradient_residual": np.nanmax(fit.history.gradient_residual),
        "seconds": fit.history.seconds.sum(),
        "limited_by": limits(fit, np.asarray(reached[best])),
    }


def note(quantity: Quantity, epoch: int, record: Record) -> dict[str, jax.Array]:
    """Shape factors and the design quantity of an epoch."""
    targets = record.parameters.target_shape_factor
    value = evaluate(quantity, record.tissue, ShapeFactorEnergy(targets))
    return {"observed": record.tissue.shape_factors, "targets": targets, "value": value}


@eqx.filter_jit
def evaluate(quantity: Quantity, tissue: Tissue, energy: ShapeFactorEnergy) -> jax.Array:
    """The design quantity."""
    if quantity == "shape_factor":
        return jnp.mean(tissue.shape_factors)
    if quantity == "shear_modulus":
        return shear_modulus(tissue, energy, throw=False)
    along, across = (
        youngs_modulus(tissue, energy, angle=angle, throw=False) for angle in (0.0, jnp.pi / 2)
    )
    return (along - across) / (along + across)


def save(initial: Tissue, fit: Fit, config: Config, folder: runs.RunFolder) -> None:
    """Write tissues, tables and figures."""
    observed, targets, value = (fit.notes[name] for name in ("observed", "targets", "value"))
    best, n_cells = int(fit.best_epoch), targets.shape[1]
    folder.save_tissue("initial", initial)
    folder.save_tissue("designed", fit.tissue)
    means = {"mean_observed": observed.mean(axis=1), "mean_parameter": targets.mean(axis=1)}
    history = runs.history_table(fit.history) | {config.quantity: value} | means
    folder.save_table("history", history)
    ends = {"initial": 0, "final": best}
    columns = {"cell": np.arange(n_cells)} | {
        f"target_{name}": targets[k] for name, k in ends.items()
    }
    columns |= {f"observed_{name}": observed[k] for name, k in ends.items()}
    folder.save_table("cells", columns)
    epoch, cell = (x.ravel() for x in np.indices(targets.shape))
    table = {"epoch": epoch, "cell": cell, "target": targets.ravel(), "observed": observed.ravel()}
    folder.save_table("cells_by_epoch", table)
    panels = {"initial": (initial, observed[0]), "designed": (fit.tissue, observed[best])}
    design = (config.quantity, value, config.target)
    folder.save_figure("design", plot_design(panels, observed, targets, design))
    plotting.plot_history(fit.history, figure=(convergence := Figure()))
    folder.save_figure("convergence", convergence)


@plotting.house_style()
def plot_design(
    panels: dict[str, tuple[Tissue, np.ndarray]],
    observed: np.ndarray,
    targets: np.ndarray,
    design: tuple[str, np.ndarray, float],
) -> Figure:
    """Tissues before and after, shape factors over epochs, and another design quantity.

    **Arguments:**

    - `panels`: tissue and shape factors of its cells by title.
    - `observed`, `targets`: shape factors at equilibrium and of the energy, of shape (epochs, cells).
    - `design`: name, values and target of the design quantity.
    """
    n, (quantity, values, target) = len(panels), design
    is_modulus = quantity != "shape_factor"
    widths = [2.3] * n + [2.7] * (1 + is_modulus)
    figure, (axes,) = plotting.new_figure(1, len(widths), width=widths, height=2.5, room=0.7)
    shown = {f"{title}: mean {p.mean():.2f}": tissue for title, (tissue, p) in panels.items()}
    shape_factors = [values for _, values in panels.values()]
    options: Any = {"axes": axes[:n], "label": r"shape factor $P/\sqrt{A}$"}
    plotting.plot_tissues(shown, shape_factors, **options)
    ax, (blue, vermilion, green, *_) = axes[n], plotting.SERIES
    lines = ax.plot(targets, color="0.75", lw=0.5)
    lines[0].set_label("$p^0$ of a cell")
    if not is_modulus:
        ax.axhline(target, color=plotting.INK, ls=":", lw=0.8, label="wanted")
    ax.plot(observed.mean(axis=1), color=blue, label="mean in equilibrium")
    # Dashed, so that both curves are visible where they agree.
    dashed: Any = {"ls": (0, (3, 3)), "lw": 0.8}
    ax.plot(targets.mean(axis=1), color=vermilion, label="mean $p^0$", **dashed)
    ax.set(xlabel="epoch", ylabel="shape factor")
    # Above the axes, which are full of curves.
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, columnspacing=1.0)
    if is_modulus:
        axes[-1].plot(values, color=green)
        axes[-1].axhline(target, color=plotting.INK, ls=":", lw=0.8)
        axes[-1].set(xlabel="epoch", ylabel=quantity.replace("_", " "))
    return figure
