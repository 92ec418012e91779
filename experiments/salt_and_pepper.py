"""Choose tensions of edges that keep cells of one type apart (paper, Figure 4c).

Cells have random types. Tensions of edges are fitted until few interfaces between cells of one type are left,
which requires T1 transitions and four-fold vertices. Tissues are free clusters and periodic ones, with two
types, where the pattern is a checkerboard, and with three.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.ticker import PercentFormatter
from pydantic import Field

import vertax as vx
from experiments._replicates import plot_band, series_colours
from experiments._shared import TensionRange, replicate_keys, spread_of
from vertax import plotting, runs
from vertax.costs import HomotypicLength
from vertax.fitting import limits, member

Boundary = Literal["periodic", "free"]
# Pale colours, under dark outlines and coloured edges.
TYPES = ListedColormap(["#f6e3c5", "#9fc8e4", "#b9dfb5", "#e5bcd6"], "cell types")


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    boundaries: list[Boundary] = Field(default=["free", "periodic"], min_length=1)
    """Kinds of tissues; the figure shows the first."""
    n_types: list[int] = Field(default=[2, 3], min_length=1)
    """Numbers of cell types, 2 to 4; the figure shows the first."""
    replicates: int = Field(default=5, ge=1)
    """Independent tissues of each kind."""
    accuracy: float = Field(default=0.01, gt=0, lt=1)
    """Fraction of interfaces between cells of one type that counts as reached."""
    relative: bool = False
    """Cost by the fraction of these interfaces, instead of their length as in the paper."""
    tissue: runs.TissueSection = runs.TissueSection(lloyd_steps=3)
    """The tissues."""
    tensions: TensionRange = TensionRange(low=0.05, high=0.2)
    """Tensions of the edges and stiffness of the cells."""
    spread: float = Field(default=0.0, ge=0, lt=1)
    """Fraction of the range of tensions that the first ones are drawn from; 0: all are equal."""
    gradient: runs.Gradient = runs.Gradient()
    """Gradients through the equilibrium."""
    fit: runs.Fitting = runs.Fitting(learning_rate=0.1, epochs=150)
    """Fit of the logits of the tensions."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(max_steps=300)
    """Relaxation of the tissues."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By kind of tissue and number of types: heterotypic fractions, T1 transitions, and limits."""
    metrics: dict[str, Any] = {}
    curves: dict[str, np.ndarray] = {}
    tables, panels = [], {}
    for boundary, n_types in ((b, n) for b in config.boundaries for n in config.n_types):
        name, problems = f"{boundary}, {n_types} types", make_problems(config, boundary, n_types)
        options: Any = {"notes": note_fraction, "progress": progress}
        fit = folder.fit_in_threads(name, problems, config.fit, **options)
        curves[name] = fractions = fit.notes["share"]
        label = {"boundary": boundary, "n_types": str(n_types)}
        labels = [label | {"replicate": str(k)} for k in range(config.replicates)]
        tables.append(runs.history_table(fit.history, *labels) | {"heterotypic_share": fractions.T.ravel()})
        folder.save_table("history", runs.concatenate(tables))
        best = np.take_along_axis(fractions, np.maximum(fit.best_epoch, 0)[None], axis=0)[0]
        metrics[name] = measure(config, fit, fractions, best)
        panels = panels or make_panels(config, problems[0], fit, (fractions[0, 0], best[0]), folder)
    bounds = (config.tensions.low, config.tensions.high)
    folder.save_figure("design", plot_patterns(panels, bounds, curves))
    return metrics


def make_problems(config: Config, boundary: str, n_types: int) -> list[vx.InverseProblem]:
    """One problem per replicate; those of one replicate differ in the types only."""
    make, n_cells = vx.initialise.free_voronoi, config.tissue.n_cells
    make = make if boundary == "free" else vx.initialise.periodic_voronoi
    problems = []
    for key in replicate_keys(config.seed, config.replicates):
        keys = jax.random.split(key, 3)
        tissue = make(n_cells, key=keys[0], lloyd_steps=config.tissue.lloyd_steps)
        types = jax.random.permutation(keys[1], jnp.arange(n_cells) % n_types)
        energy = config.tensions.draw(tissue, config.spread, keys[2])
        cost = HomotypicLength(types, config.relative)
        levels: Any = {"adjoint": config.gradient.build(), "response": config.relaxation.build()}
        problems.append(vx.InverseProblem(tissue, energy, cost, **levels))
    return problems


@eqx.filter_jit
def heterotypic_fraction(problem: Any, tissue: vx.Tissue) -> Any:
    """The fraction of the length of interfaces that lies between cells of different types."""
    return 1 - HomotypicLength(problem.cost.cell_types, relative=True)(tissue, problem.energy)


def note_fraction(problem: Any, record: Any) -> dict[str, Any]:
    """The heterotypic fraction of an epoch."""
    return {"share": heterotypic_fraction(problem, record.tissue)}


def measure(config: Config, fit: vx.Fit, fractions: np.ndarray, best: np.ndarray) -> dict[str, Any]:
    """The metrics of one kind of tissue."""
    history, reached = fit.history, best >= 1 - config.accuracy
    near = fractions.mean(axis=1) >= 1 - 2 * config.accuracy
    return {
        "share_initial": spread_of(fractions[0]),
        "share_best": spread_of(best),
        "share_last": spread_of(fractions[-1]),
        "share_best_mean": best.mean(),
        "share_best_min": best.min(),
        "epochs_to_twice_the_accuracy": int(np.argmax(near)) if near.any() else None,
        "reached_fraction": reached.mean(),
        "best_epoch": fit.best_epoch,
        "max_force": np.max(fit.max_force),
        "num_t1": history.num_t1.sum(axis=0),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.nanmax(history.gradient_residual),
        "seconds": history.seconds.sum(),
        "seconds_per_epoch": np.median(history.seconds),
        "limited_by": limits(fit, reached),
    }


def make_panels(config: Config, problem: Any, fit: vx.Fit, fractions: Any, folder: runs.RunFolder) -> Any:
    """Tissue, types and tensions of the first replicate, before and after."""
    types = np.asarray(problem.cost.cell_types)
    folder.save_table("cell_types", {"cell": np.arange(len(types)), "type": types})
    first = config.relaxation.build()(problem.tissue, problem.energy, throw=False).tissue
    designs = ((first, problem.energy), member((fit.tissue, fit.energy), 0))
    panels = {}
    for name, (tissue, energy), fraction in zip(("initial", "designed"), designs, fractions, strict=True):
        tensions = np.asarray(energy.terms[1].tension)
        panels[f"{name}: {fraction:.1%} heterotypic"] = (tissue, types, tensions)
        folder.save_tissue(name, tissue)
    return panels


@plotting.house_style()
def plot_patterns(panels: Any, bounds: tuple[float, float], curves: dict[str, np.ndarray]) -> Any:
    """Tissues before and after, and the heterotypic fraction over epochs."""
    n = len(panels)
    figure, (axes,) = plotting.new_figure(1, n + 1, width=[2.3] * n + [2.7], height=2.5, room=0.7)
    tissues = {title: tissue for title, (tissue, _, _) in panels.items()}
    types, tensions = (np.stack([p[k] for p in panels.values()]) for k in (1, 2))
    style: Any = {"cmap": TYPES, "vmin": -0.5, "vmax": TYPES.N - 0.5, "colorbar": "edges"}
    style |= {"edge_vmin": bounds[0], "edge_vmax": bounds[1], "edge_label": r"tension $\gamma$"}
    plotting.plot_tissues(tissues, types, list(tensions), axes=axes[:n], **style)
    for name, colour in series_colours(curves).items():
        plot_band(curves[name], axes[n], label=name, colour=colour)
    axes[n].axhline(1, color=plotting.INK, ls=":", lw=0.8)
    axes[n].set(xlabel="epoch", ylabel="heterotypic share of interfaces")
    axes[n].yaxis.set_major_formatter(PercentFormatter(1))
    axes[n].legend(loc="lower right")
    return figure
