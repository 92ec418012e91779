"""Choose tensions of edges that keep cells of one type apart (paper, Figure 4c).

Cells get types at random. The tensions of the edges are adjusted until hardly any interface between
cells of one type is left, which takes exchanges of neighbours and four-fold vertices. Free clusters and
periodic tissues, with two types, for which the pattern is a checkerboard, and with three.
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydantic import Field

from vertax.costs import HomotypicLength
from vertax.fitting import Fit, InverseProblem, Record, limits, member
from vertax.inference import foam_terms
from vertax.initialise import free_voronoi, periodic_voronoi
from vertax.mesh import Tissue
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Gradient,
    Relaxation,
    RunFolder,
    TensionRange,
    TissueSection,
    fit_side_by_side,
    histories,
    joined,
    replicate_keys,
    spread_of,
)

from . import figures

Boundary = Literal["periodic", "free"]


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    boundaries: list[Boundary] = Field(default=["free", "periodic"], min_length=1)
    """Kinds of tissues; the figure shows the first."""
    n_types: list[int] = Field(default=[2, 3], min_length=1)
    """Numbers of cell types, 2 to 4; the figure shows the first."""
    replicates: int = Field(default=5, ge=1)
    """Independent tissues of each kind."""
    accuracy: float = Field(default=0.01, gt=0, lt=1)
    """Share of interfaces between cells of one type that may be left."""
    relative: bool = False
    """Whether the cost is the share of these interfaces, and not their length as in the paper."""
    tissue: TissueSection = TissueSection(lloyd_steps=3)
    """The tissues."""
    tensions: TensionRange = TensionRange(low=0.05, high=0.2)
    """Tensions of the edges and stiffness of the cells."""
    spread: float = Field(default=0.0, ge=0, lt=1)
    """Share of the range of tensions that the first ones are drawn from; 0: all are equal."""
    gradient: Gradient = Gradient()
    """How gradients are taken."""
    fit: Fitting = Fitting(learning_rate=0.1, epochs=150)
    """How the tensions (their logits) are fitted."""
    relaxation: Relaxation = Relaxation(max_steps=300)
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics of each kind of tissue and number of types: heterotypic share at the start
    and at best, T1 transitions, largest force, and what limits those that fell short.

    **Raises:**

    - `FitError` if a fit cannot go on.
    """
    metrics: dict[str, Any] = {}
    shares: dict[str, np.ndarray] = {}
    tables: list[dict[str, Any]] = []
    panels: dict[str, tuple[Tissue, np.ndarray, np.ndarray]] = {}
    for boundary in config.boundaries:
        for n_types in config.n_types:
            name = f"{boundary}, {n_types} types"
            problems = _problems(config, boundary, n_types)
            outcome = fit_side_by_side(
                folder, name, problems, config.fit, notes=_share, progress=progress
            )
            shares[name] = curves = outcome.notes["share"]
            labels = [
                {"boundary": boundary, "n_types": str(n_types), "replicate": str(k)}
                for k in range(config.replicates)
            ]
            tables.append(histories(outcome, labels) | {"heterotypic_share": curves.T.ravel()})
            folder.save_table("history", joined(tables))
            metrics[name] = _metrics(config, outcome, curves)
            panels = panels or _panels(config, problems[0], outcome, curves, folder)
    bounds = (config.tensions.low, config.tensions.high)
    folder.save_figure("design", figures.patterns(panels, bounds, shares))
    return metrics


def _problems(config: Config, boundary: Boundary, n_types: int) -> list[InverseProblem]:
    """One problem a replicate; those of one replicate differ in nothing but the types."""
    make = {"free": free_voronoi, "periodic": periodic_voronoi}[boundary]
    n_cells = config.tissue.n_cells
    problems = []
    for key in replicate_keys(config.seed, config.replicates):
        keys = jax.random.split(key, 3)
        tissue = make(n_cells, key=keys[0], lloyd_steps=config.tissue.lloyd_steps)
        # As many cells of each type as can be.
        types = jax.random.permutation(keys[1], jnp.arange(n_cells) % n_types)
        problems.append(
            InverseProblem(
                tissue,
                config.tensions.draw(tissue, config.spread, keys[2]),
                HomotypicLength(types, config.relative),
                adjoint=config.gradient.build(),
                response=config.relaxation.build(),
            )
        )
    return problems


@eqx.filter_jit
def _heterotypic(problem: InverseProblem, tissue: Tissue) -> Array:
    assert isinstance(problem.cost, HomotypicLength)
    relative = HomotypicLength(problem.cost.cell_types, relative=True)
    return 1 - relative(tissue, problem.energy)


def _share(problem: InverseProblem, record: Record) -> dict[str, Array]:
    """The heterotypic share."""
    return {"share": _heterotypic(problem, record.tissue)}


def _best(outcome: Fit, curves: np.ndarray) -> np.ndarray:
    """Shares of the best designs."""
    return np.take_along_axis(curves, np.maximum(outcome.best_epoch, 0)[None], axis=0)[0]


def _metrics(config: Config, outcome: Fit, curves: np.ndarray) -> dict[str, Any]:
    history = outcome.history
    best = _best(outcome, curves)
    reached = best >= 1 - config.accuracy
    near = curves.mean(axis=1) >= 1 - 2 * config.accuracy
    return {
        "share_initial": spread_of(curves[0]),
        "share_best": spread_of(best),
        "share_last": spread_of(curves[-1]),
        "share_best_mean": best.mean(),
        "share_best_min": best.min(),
        "epochs_to_twice_the_accuracy": int(np.argmax(near)) if near.any() else None,
        "reached_fraction": reached.mean(),
        "best_epoch": outcome.best_epoch,
        "max_force": np.max(outcome.max_force),
        "num_t1": history.num_t1.sum(axis=0),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.nanmax(history.gradient_residual),
        "seconds": history.seconds.sum(),
        "seconds_per_epoch": np.median(history.seconds),
        "limited_by": limits(outcome, reached),
    }


def _panels(
    config: Config, problem: InverseProblem, outcome: Fit, curves: np.ndarray, folder: RunFolder
) -> dict[str, tuple[Tissue, np.ndarray, np.ndarray]]:
    """The first replicate before and after."""
    assert isinstance(problem.cost, HomotypicLength)
    types = np.asarray(problem.cost.cell_types)
    folder.save_table("cell_types", {"cell": np.arange(len(types)), "type": types})
    first = config.relaxation.build()(problem.tissue, problem.energy, throw=False).tissue
    panels = {}
    for name, tissue, energy, share in (
        ("initial", first, problem.energy, curves[0, 0]),
        ("designed", *member((outcome.tissue, outcome.energy), 0), _best(outcome, curves)[0]),
    ):
        tensions = np.asarray(foam_terms(energy)[1].tension)
        panels[f"{name}: {share:.1%} heterotypic"] = (tissue, types, tensions)
        folder.save_tissue(name, tissue)
    return panels
