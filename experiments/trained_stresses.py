r"""Tensions of edges that give chosen cells prescribed stresses, by three rules of learning.

The rules are the gradient by implicit differentiation, by equilibrium propagation, and *coupled learning*
(Stern, Hexner, Rocks & Liu 2021, doi:10.1103/PhysRevX.11.021045), a local rule. Stresses of cells are outputs
as in Ameen, Zhang & Schwarz 2026, arXiv:2604.25439. Coupled learning clamps them a fraction $\eta$ of the way
from the free state $F$ to their targets, $\sigma^C = \sigma^F + \eta (\sigma^t - \sigma^F)$, and compares
both states:

$$\dot\theta \propto -\frac1\eta \frac{\partial}{\partial\theta} \big(E_C(X_C, \theta) - E(X_F, \theta)\big),
\qquad E_C = E + \frac k2 \sum_c |\sigma_c - \sigma^C_c|^2$$

at fixed positions. For a soft clamp, $k \to 0$, it is equilibrium propagation.
"""

import time
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from optimistix import LevenbergMarquardt
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from experiments._shared import replicate_keys
from vertax import energies, plotting, runs
from vertax.costs import CellStress
from vertax.mechanics import cell_stress

Rule = Literal["gradient", "propagation", "coupled", "least_squares"]


class Clamp(runs.Section):
    """The clamp of coupled learning."""

    stiffness: float = Field(default=1.0, gt=0)
    """Stiffness $k$, area squared over energy."""
    share: float = Field(default=0.1, gt=0, le=1)
    """Fraction η of the way to the targets."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    rules: list[Rule] = Field(default=["gradient", "propagation", "coupled", "least_squares"], min_length=1)
    """Rules of learning; least squares (Levenberg-Marquardt) show the smallest possible distance."""
    trained: list[int] = Field(default=[1, 2, 4, 8, 16], min_length=1)
    """Numbers of cells with a target."""
    replicates: int = Field(default=3, ge=1)
    """Independent tissues and targets."""
    shape_factor: float = Field(default=3.6, gt=0)
    """Target shape factor of the cells."""
    strength: float = Field(default=0.3, gt=0)
    """Bound of the tensions, which begin at 0 and may have either sign."""
    size: float = Field(default=0.05, gt=0)
    """Standard deviation of the change of each component of a stress."""
    accuracy: float = Field(default=0.05, gt=0, lt=1)
    """Distance from the target, relative to the first one, that counts as trained."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=16, lloyd_steps=2)
    """The tissues."""
    clamp: Clamp = Clamp()
    """The clamp of coupled learning."""
    fit: runs.Fitting = runs.Fitting(learning_rate=0.05, epochs=200)
    """Optimiser of the logits of the tensions, the same for all rules."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(
        max_steps=300, contacts=False, transitions=False
    )
    """Relaxation of the tissues."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By rule: trained fraction, median distance, and cosine between first direction and gradient."""
    began, shape = time.perf_counter(), (len(config.trained), config.replicates)
    if max(config.trained) > config.tissue.n_cells:
        raise runs.ConfigError(
            f"trained must be at most tissue.n_cells, {config.tissue.n_cells}, but is {max(config.trained)}."
        )
    tissues = [prepare(config, key) for key in replicate_keys(config.seed, config.replicates)]
    errors: dict[str, np.ndarray] = {}
    directions: dict[str, np.ndarray] = {}
    courses: list[Any] = []
    for rule in config.rules:
        clamp = config.clamp if rule == "coupled" else None

        def one(index: int, rule: Rule = rule, clamp: Any = clamp) -> Any:
            number, k = (int(i) for i in np.unravel_index(index, shape))
            problem = make_problem(config, tissues[k], config.trained[number], k, rule)
            if rule == "least_squares":
                return solve(problem, config.fit.epochs)
            constants = None if clamp is None else (jnp.asarray(clamp.stiffness), jnp.asarray(clamp.share))
            return learn(problem, config.fit.build(), config.fit.epochs, constants)

        courses = folder.map_in_threads(one, shape[0] * shape[1], progress=progress, unit=rule)
        cost = np.stack([np.where(converged, cost, np.nan) for cost, converged, *_ in courses])
        errors[rule] = np.sqrt(cost / cost[:, :1]).reshape(*shape, config.fit.epochs)
        if rule != "least_squares":
            directions[rule] = np.stack([ravel_pytree(first)[0] for _, _, first, *_ in courses])
        folder.save_tissue(rule, courses[-1][-1])
    folder.save_array("errors", np.stack(list(errors.values())))
    best = {rule: np.fmin.reduce(values, axis=-1) for rule, values in errors.items()}
    medians = {rule: np.median(values, axis=1) for rule, values in best.items()}
    folder.save_table("distances", {"cells": config.trained} | medians)
    *_, energy, tissue = courses[-1]
    stresses = np.asarray(cell_stress(tissue, energy))
    folder.save_figure("training", plot_training(tissue, stresses, config.trained, errors))
    metrics: dict[str, Any] = {
        rule: {
            "trained_share": (values <= config.accuracy).mean(axis=1).tolist(),
            "distance": medians[rule].tolist(),
            "cosine": mean_cosine(directions.get(rule), directions.get("gradient")),
        }
        for rule, values in best.items()
    }
    return metrics | {"seconds": time.perf_counter() - began}


def mean_cosine(a: np.ndarray | None, b: np.ndarray | None) -> float | None:
    """The mean over rows of the cosine between two vectors."""
    if a is None or b is None:
        return None
    return float(np.mean(np.sum(a * b, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))))


def make_energy(config: Config, tissue: vx.Tissue) -> energies.LocalSum:
    """Elastic areas and perimeters, and bounded tensions of 0."""
    tensions = energies.BoundedTension(jnp.zeros(tissue.n_edges), -config.strength, config.strength)
    cells = energies.AreaElasticity(1.0, 1.0), energies.PerimeterElasticity(1.0, config.shape_factor)
    return energies.LocalSum((*cells, tensions))


def prepare(config: Config, key: Any) -> vx.Tissue:
    """A relaxed tissue, first relaxed with T1 transitions because a random tissue has short edges."""
    section = config.tissue
    start = vx.initialise.periodic_voronoi(section.n_cells, key=key, lloyd_steps=section.lloyd_steps)
    energy = make_energy(config, start)
    settled = vx.Relaxation(contact_range=None)(start, energy, throw=False).tissue
    return config.relaxation.build()(settled, energy, throw=False).tissue


def make_problem(config: Config, tissue: vx.Tissue, number: int, k: int, rule: Rule) -> vx.InverseProblem:
    """Targets for `number` cells; the cells of a smaller number are among those of a larger one."""
    n, energy = config.tissue.n_cells, make_energy(config, tissue)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 1000 + k))
    change = config.size * jax.random.normal(keys[1], (n, 2, 2))
    target = cell_stress(tissue, energy) + 0.5 * (change + jnp.swapaxes(change, 1, 2))
    # Cells are repeated up to n entries: one compiled function serves all numbers of cells.
    cells = jax.random.permutation(keys[0], n)[:number]
    cells = jnp.resize(cells, (n // number * number,))
    cells = jnp.concatenate([cells, cells[: n - cells.size]])
    trainable = eqx.tree_at(lambda e: e.terms[2].logits, jax.tree.map(lambda _: False, energy), True)
    propagation = rule == "propagation"
    adjoint: Any = vx.EquilibriumPropagation() if propagation else vx.ImplicitDifferentiation()
    options: Any = {"response": config.relaxation.build(), "adjoint": adjoint}
    return vx.InverseProblem(tissue, energy, CellStress(target[cells], cells), trainable, **options)


class Clamped(vx.AbstractEnergy):
    """The energy with springs that pull the chosen stresses to their clamped values."""

    energy: vx.AbstractEnergy
    stiffness: jax.Array
    clamped: CellStress

    def __call__(self, tissue: vx.Tissue) -> Any:
        # The cost is the mean over the chosen cells.
        number = self.clamped.target.shape[0]
        return self.energy(tissue) + self.stiffness * number * self.clamped(tissue, self.energy)


def gradient_step(problem: vx.InverseProblem, energy: Any, tissue: vx.Tissue) -> tuple:
    """Cost, gradient, relaxed tissue and whether it converged."""
    result = problem.value_and_gradient(energy, tissue, throw=False)
    return result.cost, result.gradient, result.equilibrium.tissue, result.equilibrium.converged


def coupled_step(problem: vx.InverseProblem, energy: Any, tissue: vx.Tissue, clamp: Any) -> tuple:
    """The same with the difference between clamped and free state in place of the gradient."""
    (stiffness, share), cost = clamp, problem.cost
    assert isinstance(cost, CellStress)
    free = problem.response(tissue, energy, throw=False)
    stress = cell_stress(free.tissue, energy)[cost.cells]
    target = CellStress(stress + share * (cost.target - stress), cost.cells)
    clamped = problem.response(free.tissue, Clamped(energy, stiffness, target), throw=False)
    parameters, constants = eqx.partition(energy, problem.trainable)

    def contrast(parameters: Any) -> Any:
        changed = eqx.combine(parameters, constants)
        return (Clamped(changed, stiffness, target)(clamped.tissue) - changed(free.tissue)) / share

    direction, converged = jax.grad(contrast)(parameters), free.converged & clamped.converged
    return cost(free.tissue, energy), direction, free.tissue, converged


@eqx.filter_jit
def learn(problem: vx.InverseProblem, optimiser: Any, epochs: int, clamp: Any) -> tuple:
    """Costs, convergence, first direction, energy and tissue; with the gradient if there is no clamp."""
    parameters, constants = eqx.partition(problem.energy, problem.trainable)
    arrays, static = eqx.partition(problem.tissue, eqx.is_array)

    def epoch(carry: tuple, _: None) -> tuple[tuple, tuple]:
        parameters, state, arrays = carry
        arguments = problem, eqx.combine(parameters, constants), eqx.combine(arrays, static)
        step = gradient_step(*arguments) if clamp is None else coupled_step(*arguments, clamp)
        cost, direction, tissue, converged = step
        updates, state = optimiser.update(direction, state, parameters)
        carry = eqx.apply_updates(parameters, updates), state, eqx.filter(tissue, eqx.is_array)
        return carry, (cost, converged, direction)

    start = parameters, optimiser.init(parameters), arrays
    (parameters, _, arrays), (cost, converged, directions) = jax.lax.scan(epoch, start, length=epochs)
    first = jax.tree.map(lambda x: x[0], directions)
    return cost, converged, first, eqx.combine(parameters, constants), eqx.combine(arrays, static)


def solve(problem: vx.InverseProblem, epochs: int) -> tuple:
    """The same by at most 30 steps of least squares, without a direction; later epochs repeat the last."""
    fit = vx.fit(problem, LevenbergMarquardt(rtol=1e-8, atol=1e-10), min(epochs, 30), progress=False)
    history, width = fit.history, (0, epochs - len(fit.history.cost))
    cost, converged = (np.pad(x, width, mode="edge") for x in (history.cost, history.converged))
    start = float(problem.cost(problem.tissue, problem.energy))
    return np.concatenate([[start], cost[:-1]]), converged, None, fit.energy, fit.tissue


@plotting.house_style()
def plot_training(tissue: vx.Tissue, stresses: np.ndarray, trained: list[int], errors: Any) -> Any:
    """A trained tissue with its stresses, distances from the target by epoch, and the smallest ones."""
    figure, ((shown, curves, distances),) = plotting.new_figure(1, 3, width=2.3)
    plotting.plot_stress(tissue, stresses, ax=shown)
    for rule, colour in series_colours(errors).items():
        # One curve per number of cells: the paler, the smaller.
        for i, curve in enumerate(np.nanmedian(errors[rule], axis=1)):
            label = rule if i == len(trained) - 1 else None
            curves.plot(curve, color=colour, lw=0.8, alpha=(i + 1) / len(trained), label=label)
        best = np.median(np.fmin.reduce(errors[rule], axis=-1), axis=1)
        distances.plot(trained, best, "o-", ms=3, color=colour, label=rule)
    curves.set(xlabel="epoch", ylabel="distance from target, relative", yscale="log")
    distances.set(xlabel="trained cells", ylabel="smallest distance, relative", yscale="log")
    distances.set_xscale("log", base=2)
    curves.legend()
    return figure
