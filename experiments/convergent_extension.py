"""Choose tensions of edges that elongate a cluster of cells (paper, Figure 4b).

Free clusters of the energy E2, of several sizes, have a tension for each edge. They are first brought from
random tensions to one aspect ratio, at which all designs start; then tensions are fitted to a larger aspect
ratio. Cells change neighbours on the way. With `measure = "box"` tissues are periodic: their box relaxes at
fixed area to zero shear stress, and its aspect ratio is the target.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from experiments._shared import TensionRange, columns, plot_tensions, replicate_keys, spread_of
from vertax import plotting, runs
from vertax.costs import AspectRatio, aspect_ratio
from vertax.fitting import limits, member


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    n_cells: list[int] = Field(default=[6, 12, 18], min_length=1)
    """Sizes of the clusters."""
    targets: list[float] = Field(default=[1.75, 2.0, 2.25, 2.5, 2.75, 3.0], min_length=1)
    """Target aspect ratios."""
    start_ratio: float = Field(default=1.5, gt=1)
    """Aspect ratio at which all designs start."""
    measure: Literal["moments", "farthest", "box"] = "moments"
    """Aspect ratio by second moments of the area, by the farthest vertices (paper), or of a periodic box."""
    accuracy: float = Field(default=1e-2, gt=0)
    """Distance from the target that counts as reached."""
    replicates: int = Field(default=5, ge=1)
    """Independent clusters of each size."""
    shown: int = Field(default=12, ge=2)
    """Size of the cluster in the figure, or the nearest one."""
    shown_target: float = Field(default=2.75, gt=1)
    """Its target, or the nearest one."""
    tensions: TensionRange = TensionRange()
    """Tensions of the edges and stiffness of the cells."""
    spread: float = Field(default=0.5, ge=0, lt=1)
    """Fraction of the range of tensions that the first ones are drawn from."""
    gradient: runs.Gradient = runs.Gradient()
    """Gradients through the equilibrium."""
    start: runs.Fitting = runs.Fitting(learning_rate=0.1, epochs=60)
    """Fit to the aspect ratio of the start."""
    fit: runs.Fitting = runs.Fitting(learning_rate=0.1, epochs=200)
    """Fit of the logits of the tensions."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=300)
    """Relaxation of the tissues."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By size: squared errors, T1 transitions, largest force, and the limits of designs that fall short."""
    metrics: dict[str, Any] = {}
    designs: dict[int, tuple[vx.Fit, vx.Fit]] = {}
    tables, rows = [], []
    for n in config.n_cells:
        designs[n] = start, fit = design(config, n, folder, progress)
        labels = [{"n_cells": str(n), "target": str(t), "replicate": str(k)} for t, k in members(config)]
        tables.append(
            runs.history_table(fit.history, *labels) | {"aspect_ratio": fit.notes["ratio"].T.ravel()}
        )
        metrics[f"{n} cells"] = measure(config, start, fit)
        folder.save_table("history", runs.concatenate(tables))
        for (target, k), ratio in zip(members(config), ratios_of(config, fit).ravel(), strict=True):
            error = {"aspect_ratio": ratio, "squared_error": (ratio - target) ** 2}
            rows.append({"n_cells": n, "target": target, "replicate": k} | error)
    folder.save_table("aspect_ratios", columns(rows))
    targets = np.array(config.targets)
    shown = int(np.argmin(np.abs(targets - config.shown_target))) * config.replicates
    start, fit = designs[min(designs, key=lambda n: abs(n - config.shown))]
    panels = {}
    for name, each, k in (("initial", start, 0), ("designed", fit, shown)):
        tissue, energy = member((each.tissue, each.energy), k)
        tension = np.asarray(energy.terms[1].tension)
        panels[f"{name}: $r$ = {ratios_of(config, each).ravel()[k]:.2f}"] = (tissue, tension)
        folder.save_tissue(name, tissue)
    ratios = {n: ratios_of(config, fit) for n, (_, fit) in designs.items()}
    bounds = (config.tensions.low, config.tensions.high)
    folder.save_figure("design", plot_elongation(panels, bounds, targets, ratios))
    return metrics


def members(config: Config) -> list[tuple[float, int]]:
    """Target and replicate of each member of a batch."""
    return [(target, k) for target in config.targets for k in range(config.replicates)]


def design(config: Config, n_cells: int, folder: runs.RunFolder, progress: bool) -> tuple[vx.Fit, vx.Fit]:
    """The fits to the aspect ratio of the start, and to the targets."""
    response, make = config.relaxation.build(), vx.initialise.free_voronoi
    if config.measure == "box":
        response = vx.mechanics.BoxRelaxation(free="shape", relaxation=response)
        make = vx.initialise.periodic_voronoi
    problems = []
    for key in replicate_keys(config.seed, config.replicates):
        cluster = make(n_cells, key=key, lloyd_steps=2)
        energy = config.tensions.draw(cluster, config.spread, key)
        cost = AspectRatio(jnp.array(config.start_ratio), config.measure)
        levels: Any = {"adjoint": config.gradient.build(), "response": response}
        problems.append(vx.InverseProblem(cluster, energy, cost, **levels))
    name, options = f"{n_cells} cells", {"notes": note_ratio, "progress": progress}
    start = folder.fit_in_threads(f"{name} first", problems, config.start, **options)
    designs = []
    for target, k in members(config):
        tissue, energy = member((start.tissue, start.energy), k)
        parts = (tissue, energy, AspectRatio(jnp.array(target), config.measure))
        designs.append(eqx.tree_at(lambda p: (p.tissue, p.energy, p.cost), problems[k], parts))
    return start, folder.fit_in_threads(name, designs, config.fit, **options)


measure_ratio = eqx.filter_jit(aspect_ratio)


def note_ratio(problem: Any, record: Any) -> dict[str, Any]:
    """The aspect ratio of an epoch."""
    return {"ratio": measure_ratio(record.tissue, problem.cost.measure)}


def ratios_of(config: Config, fit: vx.Fit) -> np.ndarray:
    """Aspect ratios of the best designs, of shape (targets, replicates), or (1, replicates) of the start."""
    measured = eqx.filter_vmap(lambda tissue: aspect_ratio(tissue, config.measure))
    return np.asarray(eqx.filter_jit(measured)(fit.tissue), float).reshape(-1, config.replicates)


def measure(config: Config, start: vx.Fit, fit: vx.Fit) -> dict[str, Any]:
    """The metrics of one size."""
    by_target = lambda x: np.asarray(x).reshape(len(config.targets), config.replicates)
    ratios, history = ratios_of(config, fit), fit.history
    squared = (ratios - np.array(config.targets)[:, None]) ** 2
    limited_by = by_target(limits(fit, (squared <= config.accuracy**2).ravel()))
    num_t1, best_epoch = by_target(history.num_t1.sum(axis=0)), by_target(fit.best_epoch)
    return {
        "start_ratio": spread_of(ratios_of(config, start)),
        "squared_error_mean": squared.mean(),
        "squared_error_max": squared.max(),
        "reached_fraction": np.mean(limited_by == "reached"),
        "max_force": np.max(fit.max_force),
        "num_t1": history.num_t1.sum(),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.nanmax(history.gradient_residual),
        "seconds": history.seconds.sum() + start.history.seconds.sum(),
        "seconds_per_epoch": np.median(history.seconds),
        "targets": {
            str(target): {
                "squared_error": spread_of(squared[k]),
                "ratios": ratios[k],
                "num_t1": num_t1[k],
                "best_epoch": best_epoch[k],
                "limited_by": limited_by[k].tolist(),
            }
            for k, target in enumerate(config.targets)
        },
    }


@plotting.house_style()
def plot_elongation(panels: Any, bounds: tuple[float, float], targets: np.ndarray, ratios: Any) -> Any:
    """Tissues before and after, aspect ratios and errors against the target, by number of cells."""
    figure, (reached, error) = plot_tensions(panels, bounds, [2.7, 2.7])
    reached.plot(targets, targets, color=plotting.INK, ls=":", lw=0.8)
    colours, step = series_colours(f"{n} cells" for n in ratios), 0.012 * (np.ptp(targets) or 1.0)
    for k, ((name, colour), values) in enumerate(zip(colours.items(), ratios.values(), strict=True)):
        # Shifted sideways: designs that reach their target would hide each other.
        at = targets + step * (k - (len(ratios) - 1) / 2)
        style: Any = {"color": colour, "label": name, "ms": 3, "lw": 0.8, "capsize": 2}
        reached.errorbar(at, values.mean(1), values.std(1), fmt="o", **style)
        squared = (values - targets[:, None]) ** 2
        mean, deviation = squared.mean(1), squared.std(1)
        # A bar on a logarithmic axis must end above zero.
        error.errorbar(at, mean, [np.minimum(deviation, 0.9 * mean), deviation], fmt="o-", **style)
    reached.set(xlabel="target aspect ratio", ylabel="aspect ratio reached")
    error.set(xlabel="target aspect ratio", ylabel="squared error", yscale="log")
    reached.legend()
    return figure
