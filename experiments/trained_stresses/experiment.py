"""Chosen cells of a tissue are to have given stresses, and the tensions of all edges learn to give them.

Three rules are compared: the gradient by implicit differentiation, by equilibrium propagation, and coupled
learning, for more and more cells at once (trained stresses: Ameen, Zhang & Schwarz 2026, arXiv:2604.25439).
"""

from __future__ import annotations

import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from pydantic import Field

from vertax import EquilibriumPropagation, ImplicitDifferentiation, InverseProblem, Tissue
from vertax.costs import CellStress
from vertax.energies import AreaElasticity, BoundedTension, LocalSum, PerimeterElasticity
from vertax.initialise import periodic_voronoi
from vertax.mechanics import cell_stress
from vertax.relax import Relaxation as Response
from vertax.runs import (
    ConfigError,
    ExperimentConfig,
    Fitting,
    Relaxation,
    RunFolder,
    Section,
    TissueSection,
    replicate_keys,
    side_by_side,
)

from . import figures
from .learning import Course, Teacher, learn, solve

Rule = Literal["gradient", "propagation", "coupled", "least_squares"]


class Clamp(Section):
    """The teacher of coupled learning."""

    stiffness: float = Field(default=1.0, gt=0)
    """Stiffness of its pull, area squared over energy; soft, it is equilibrium propagation."""
    share: float = Field(default=0.1, gt=0, le=1)
    """How far it pulls towards what is asked for."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    rules: list[Rule] = Field(
        default=["gradient", "propagation", "coupled", "least_squares"], min_length=1
    )
    """How tensions learn; least squares (Levenberg-Marquardt) are no learning, but tell what there is to
    learn."""
    trained: list[int] = Field(default=[1, 2, 4, 8, 16], min_length=1)
    """Numbers of cells that are trained at once."""
    replicates: int = Field(default=3, ge=1)
    """Independent tissues, with targets of their own."""
    shape_factor: float = Field(default=3.6, gt=0)
    """Target shape factor of the cells."""
    strength: float = Field(default=0.3, gt=0)
    """Bound of the tensions, which begin at 0 and may have either sign."""
    size: float = Field(default=0.05, gt=0)
    """Standard deviation of what is asked for beyond the stress that there is, in each component."""
    accuracy: float = Field(default=0.05, gt=0, lt=1)
    """Distance from the target, relative to the first one, that counts as trained."""
    tissue: TissueSection = TissueSection(n_cells=16, lloyd_steps=2)
    """The tissues."""
    clamp: Clamp = Clamp()
    """Of coupled learning."""
    fit: Fitting = Fitting(learning_rate=0.05, epochs=200)
    """How directions become steps (of the logits of the tensions), the same for all rules."""
    relaxation: Relaxation = Relaxation(max_steps=300, contacts=False, transitions=False)
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics of each rule: for each number of cells the share of tissues that are trained and
    the median distance from the target, relative to the first one; and the cosine between its first direction
    and the gradient.

    **Raises:**

    - `ConfigError` for more trained cells than there are.
    """
    began = time.perf_counter()
    if max(config.trained) > config.tissue.n_cells:
        raise ConfigError(
            f"trained must be at most tissue.n_cells, {config.tissue.n_cells}, but is {max(config.trained)}."
        )
    response = config.relaxation.build()
    tissues = [_prepared(config, response, k) for k in range(config.replicates)]
    errors: dict[str, np.ndarray] = {}
    firsts: dict[str, np.ndarray] = {}
    courses: list[Course] = []
    shape = (len(config.trained), config.replicates)
    for rule in config.rules:
        teacher = None
        if rule == "coupled":
            clamp = config.clamp
            teacher = Teacher(jnp.asarray(clamp.stiffness), jnp.asarray(clamp.share))

        def one(index: int, rule: Rule = rule, teacher: Teacher | None = teacher) -> Course:
            number, k = np.unravel_index(index, shape)
            problem = _problem(config, response, tissues[k], int(number), int(k), rule)
            if rule == "least_squares":
                return solve(problem, config.fit.epochs)
            return learn(problem, config.fit.build(), config.fit.epochs, teacher)

        courses = side_by_side(one, shape[0] * shape[1], folder, progress=progress, unit=rule)
        cost = np.stack([np.where(c.converged, c.cost, np.nan) for c in courses])
        errors[rule] = np.sqrt(cost / cost[:, :1]).reshape(*shape, config.fit.epochs)
        if rule != "least_squares":
            firsts[rule] = np.stack([ravel_pytree(c.first)[0] for c in courses])
        folder.save_tissue(rule, courses[-1].tissue)
    folder.save_array("errors", np.stack(list(errors.values())))
    best = {rule: np.fmin.reduce(values, axis=-1) for rule, values in errors.items()}
    columns: dict[str, Any] = {"cells": config.trained}
    columns |= {rule: np.median(values, axis=1) for rule, values in best.items()}
    folder.save_table("distances", columns)
    shown = courses[-1]
    stresses = np.asarray(cell_stress(shown.tissue, shown.energy))
    folder.save_figure("training", figures.training(shown.tissue, stresses, config.trained, errors))
    return {
        rule: {
            "trained_share": (values <= config.accuracy).mean(axis=1).tolist(),
            "distance": np.median(values, axis=1).tolist(),
            "cosine": _cosine(firsts.get(rule), firsts.get("gradient")),
        }
        for rule, values in best.items()
    } | {"seconds": time.perf_counter() - began}


def _prepared(config: Config, response: Response, k: int) -> Tissue:
    key = replicate_keys(config.seed, config.replicates)[k]
    n, steps = config.tissue.n_cells, config.tissue.lloyd_steps
    start = periodic_voronoi(n, key=key, lloyd_steps=steps)
    # Once with transitions: a random tissue has edges that should not be.
    settled = Response(contact_range=None)(start, _energy(config, start), throw=False).tissue
    return response(settled, _energy(config, start), throw=False).tissue


def _energy(config: Config, tissue: Tissue) -> LocalSum:
    tensions = BoundedTension(jnp.zeros(tissue.n_edges), -config.strength, config.strength)
    cells = AreaElasticity(1.0, 1.0), PerimeterElasticity(1.0, config.shape_factor)
    return LocalSum((*cells, tensions))


def _problem(
    config: Config, response: Response, tissue: Tissue, number: int, k: int, rule: Rule
) -> InverseProblem:
    n, energy = config.tissue.n_cells, _energy(config, tissue)
    key = jax.random.fold_in(jax.random.key(config.seed), 1000 + k)
    keys = jax.random.split(key)
    # The cells of a small number are among those of a larger one.
    cells = jax.random.permutation(keys[0], n)[: config.trained[number]]
    more = config.size * jax.random.normal(keys[1], (n, 2, 2))
    wanted = cell_stress(tissue, energy) + 0.5 * (more + jnp.swapaxes(more, 1, 2))
    # Each as often as it fits in: any number of cells is the same program.
    cells = jnp.resize(cells, (n // cells.size * cells.size,))
    cells = jnp.concatenate([cells, cells[: n - cells.size]])
    trainable = jax.tree.map(lambda _: False, energy)
    trainable = eqx.tree_at(lambda e: e.terms[2].logits, trainable, True)
    adjoint = EquilibriumPropagation() if rule == "propagation" else ImplicitDifferentiation()
    return InverseProblem(
        tissue,
        energy,
        CellStress(wanted[cells], cells),
        trainable=trainable,
        response=response,
        adjoint=adjoint,
    )


def _cosine(a: np.ndarray | None, b: np.ndarray | None) -> float | None:
    """Mean over rows."""
    if a is None or b is None:
        return None
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return float(np.mean(np.sum(a * b, axis=1) / lengths))
