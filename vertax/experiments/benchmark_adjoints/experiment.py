"""Compare the ways to differentiate through an equilibrium on one inverse problem (paper, Figure 2).

Hidden shape factors of small tissues are inferred from their vertices by automatic differentiation (AD),
implicit differentiation in adjoint-state and sensitivity form (Adj-ID, Sen-ID) and equilibrium
propagation (EP): with the protocol of the paper, whose relaxations stop early, and with true equilibria.
Beside the paper's comparison of results, time and memory there are the accuracy of each gradient as
the relaxation is cut short, which explains the differences, and as the nudge of EP varies.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from pydantic import Field

from vertax.adjoints import (
    AbstractAdjoint,
    AutomaticDifferentiation,
    EquilibriumPropagation,
    ImplicitDifferentiation,
)
from vertax.costs import VertexDistance
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem, stack
from vertax.inference import Scene, pearson, relative_error, same_neighbours, shape_factor_scene
from vertax.responses import Relaxation as Response
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

Method = Literal["AD", "Adj-ID", "Sen-ID", "EP"]
_GRADIENTS: dict[Method, str] = {
    "AD": "unrolled",
    "Adj-ID": "implicit",
    "Sen-ID": "sensitivity",
    "EP": "propagation",
}


class Protocol(Section):
    """How both levels of the problem are solved."""

    relaxation: Relaxation = Relaxation()
    """How tissues are relaxed."""
    unrolled: Relaxation = Relaxation(
        solver="momentum", learning_rate=3e-3, tolerance=1e-6, max_steps=20_000
    )
    """The same for AD, which needs a solver of fixed steps."""
    fit: Fitting = Fitting()
    """How the parameters are fitted."""
    gradient: Gradient = Gradient(strict=True)
    """How gradients are taken; the method is each in turn."""


class Scaling(Section):
    """Time and memory against the number of cells."""

    sizes: list[int] = Field(default=[20, 50, 100, 200, 500, 1000])
    """Numbers of cells; none leaves this part out."""
    epochs: int = Field(default=5, ge=1)
    """Epochs that are timed, each after a small change of the parameters; the median counts."""
    largest_unrolled: int = Field(default=200, ge=0)
    """Most cells for AD, whose relaxations take more and more steps."""
    largest_sensitivity: int = Field(default=200, ge=0)
    """Most cells for Sen-ID, which solves a system for every cell."""


class Accuracy(Section):
    """Accuracy of the gradients against a dense reference."""

    tolerances: list[float] = Field(default=[1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
    """Forces at which the relaxation stops; none leaves this part out."""
    betas: list[float] = Field(default=[1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
    """Strengths of the linear nudge of EP, at true equilibria."""
    cost_betas: list[float] = Field(default=[1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0])
    """Strengths of its nudge by the cost, energy per cost."""
    fitted_betas: list[float] = Field(default=[1e-1, 1.0, 10.0])
    """Strengths of the nudge in fits with the paper's protocol."""
    n_cells: int = Field(default=20, ge=4)
    """Number of cells."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    replicates: int = Field(default=5, ge=2)
    """Independent tissues; they are fitted as one batch."""
    methods: list[Method] = Field(default=list(_GRADIENTS))
    """Ways to differentiate."""
    least_squares_steps: int = Field(default=25, ge=0)
    """Outer steps of Levenberg-Marquardt, at true equilibria; 0 leaves it out."""
    tissue: TissueSection = TissueSection()
    """The tissues."""
    truth: ShapeFactors = ShapeFactors()
    """Distribution of the hidden shape factors, and of the guesses."""
    paper: Protocol = Protocol()
    """The paper's protocol."""
    equilibrium: Protocol = Protocol()
    """True equilibria."""
    scaling: Scaling = Scaling()
    """Time and memory."""
    accuracy: Accuracy = Accuracy()
    """Accuracy of the gradients."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics: for each protocol and method the final Pearson correlations and relative
    errors, and the ratios of time and memory.
    """
    metrics: dict[str, Any] = {}
    for name in ("paper", "equilibrium"):
        metrics |= _inference(config, name, folder, progress)
    if config.accuracy.tolerances:
        metrics["hypergradient"] = _accuracy(config, folder)
        metrics["beta"] = _beta_scan(config, folder, progress)
    if config.scaling.sizes:
        for group, measured in _scaling(config, folder).items():
            metrics.setdefault(group, {}).update(measured)
    return metrics


# --- inference -----------------------------------------------------------------------------------------


def _inference(config: Config, name: str, folder: RunFolder, progress: bool) -> dict[str, Any]:
    """Fits of all replicates by all methods, and what they found."""
    protocol = _protocol(config, name)
    scenes = _scenes(config, protocol.relaxation)
    batch = stack(scenes)
    fits: dict[str, Fit] = {}
    for method in config.methods:
        problem = _problem(batch, protocol, method)
        fits[method] = folder.fit(
            f"{name} {method}",
            problem,
            protocol.fit.build(),
            protocol.fit.epochs,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
    if name == "equilibrium" and config.least_squares_steps:
        fits["LM"] = folder.fit(
            f"{name} LM",
            _problem(batch, protocol, "Adj-ID"),
            optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12),
            config.least_squares_steps,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
    true, initial = _shape_factors(batch.truth), _shape_factors(batch.guess)
    inferred = {method: _shape_factors(outcome.energy) for method, outcome in fits.items()}
    columns = {"replicate": np.repeat(np.arange(len(true)), true.shape[1]), "true": true.ravel()}
    columns |= {"initial": initial.ravel()} | {m: values.ravel() for m, values in inferred.items()}
    folder.save_table(f"shape_factors_{name}", columns)
    replicates = [str(k) for k in range(config.replicates)]
    tables = [
        histories(outcome, [{"method": method, "replicate": k} for k in replicates])
        for method, outcome in fits.items()
    ]
    folder.save_table(f"history_{name}", joined(tables))
    title = {"paper": "the paper's protocol", "equilibrium": "true equilibria"}[name]
    figure = figures.inference(fits, true, initial, inferred, title=title)
    folder.save_figure(f"inference_{name}", figure)
    return {
        f"{name} {method}": _recovery(true, inferred[method], outcome)
        for method, outcome in fits.items()
    }


def _recovery(true: np.ndarray, inferred: np.ndarray, outcome: Fit) -> dict[str, Any]:
    history = outcome.history
    correlation, error = pearson(true, inferred), relative_error(true, inferred)
    return {
        "pearson_mean": correlation.mean(),
        "pearson_min": correlation.min(),
        "relative_error_mean": error.mean(),
        "relative_error_max": error.max(),
        "cost_mean": np.mean(outcome.cost),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.median(history.gradient_residual),
        "num_t1": history.num_t1.sum(),
        "epochs": len(history.cost),
        "ms_per_epoch_of_batch": 1e3 * np.median(history.seconds[1:]),
        "pearson": correlation,
        "relative_error": error,
        "epochs_to_1e-6": _first_below(history.relative_error.max(axis=1), 1e-6),
    }


def _first_below(curve: np.ndarray, level: float) -> int | None:
    below = np.flatnonzero(curve < level)
    return int(below[0]) if below.size else None


def _protocol(config: Config, name: str) -> Protocol:
    return {"paper": config.paper, "equilibrium": config.equilibrium}[name]


def _scene(config: Config, key: jax.Array, response: Response, n_cells: int | None = None) -> Scene:
    size = {} if n_cells is None else {"n_cells": n_cells}
    tissue = config.tissue.model_dump() | size
    return shape_factor_scene(key=key, response=response, **tissue, **config.truth.model_dump())


def _scenes(config: Config, relaxation: Relaxation, n_cells: int | None = None) -> list[Scene]:
    """As many scenes as replicates, in each of which start and target have one topology."""
    # Vertices are compared by number, which means nothing across a T1 transition: as in the paper,
    # guesses that relax into other neighbours are not for this benchmark.
    response = relaxation.build()
    scenes: list[Scene] = []
    for key in jax.random.split(jax.random.key(config.seed), 20 * config.replicates):
        scene = _scene(config, key, Response(), n_cells)
        if same_neighbours(scene.initial, scene.target):
            initial = response(scene.target, scene.guess, throw=False).tissue
            scenes.append(eqx.tree_at(lambda s: s.initial, scene, initial))
        if len(scenes) == config.replicates:
            return scenes
    raise ValueError(
        f"Only {len(scenes)} of {20 * config.replicates} guesses relax into the topology of their "
        "target: choose a smaller truth.deviation or truth.mean."
    )


def _problem(scene: Scene, protocol: Protocol, method: Method) -> InverseProblem[ShapeFactorEnergy]:
    relaxation = protocol.unrolled if method == "AD" else protocol.relaxation
    gradient = protocol.gradient.model_copy(update={"method": _GRADIENTS[method]})
    return InverseProblem(
        scene.initial,
        scene.guess,
        VertexDistance(scene.target),
        adjoint=gradient.build(),
        **vars(relaxation.build()),
    )


def _shape_factors(energy: ShapeFactorEnergy) -> np.ndarray:
    return np.asarray(energy.target_shape_factor, float)


# --- accuracy ------------------------------------------------------------------------------------------


class _Case(eqx.Module):
    """A relaxation to differentiate, and the right answer."""

    scene: Scene
    reference: jax.Array
    settled: Any


def _cases(config: Config) -> list[_Case]:
    cases = []
    for scene in _scenes(config, Relaxation(), config.accuracy.n_cells):
        # From the hidden tissue to that of the guess: the relaxation has some way to go.
        exact = Response(transitions=None, tolerance=1e-12)
        settled = exact(scene.target, scene.guess).tissue
        cases.append(_Case(scene, _dense(scene, settled), settled))
    return cases


def _dense(scene: Scene, settled: Any) -> jax.Array:
    """The hypergradient at an equilibrium by the pseudo-inverse of its dense Hessian."""
    cost, shape = VertexDistance(scene.target), settled.vertices.shape
    place = lambda y: settled.with_configuration(y.reshape(shape))
    y = settled.vertices.ravel()
    pull = jax.grad(lambda y: cost(place(y), scene.guess))(y)
    hessian = jax.jit(jax.hessian(lambda y: scene.guess(place(y))))(y)

    def force(p: jax.Array) -> jax.Array:
        return jax.grad(lambda y: ShapeFactorEnergy(p)(place(y)))(y)

    mixed = jax.jit(jax.jacobian(force))(scene.guess.target_shape_factor)
    return -mixed.T @ jnp.linalg.pinv(hessian, rtol=1e-10, hermitian=True) @ pull


def _gradient_error(response: Response) -> Callable[..., jax.Array]:
    """How far a gradient is from the reference, as a function of tolerance and adjoint."""

    @eqx.filter_jit
    def error(case: _Case, adjoint: AbstractAdjoint, start: Any, tolerance: Any) -> jax.Array:
        settings = dataclasses.replace(response, transitions=None, tolerance=tolerance)
        problem = InverseProblem(
            start,
            case.scene.guess,
            VertexDistance(case.scene.target),
            adjoint=adjoint,
            **vars(settings),
        )
        _, _, (gradient, _), _ = problem.value_and_gradient()
        assert gradient is not None
        difference = gradient.target_shape_factor - case.reference
        return jnp.linalg.norm(difference) / jnp.linalg.norm(case.reference)

    return error


def _accuracy(config: Config, folder: RunFolder) -> dict[str, Any]:
    """Error of each gradient against the force at which the relaxation stopped."""
    # A first-order solver ends just below the tolerance; Newton's method would overshoot it.
    relaxation = config.equilibrium.unrolled.model_copy(update={"max_steps": 50_000, "patience": 1})
    error = _gradient_error(relaxation.build())
    # "As it is usually done": no more steps than the tissue itself needs, and nudged tissues are
    # relaxed no better than the tissue.
    adjoints: dict[str, AbstractAdjoint] = {
        "AD": AutomaticDifferentiation(throw=False),
        "AD, no step more": AutomaticDifferentiation(rtol=1e9, throw=False),
        "Adj-ID": ImplicitDifferentiation(throw=False),
        "Sen-ID": ImplicitDifferentiation("sensitivity", throw=False),
        "EP": EquilibriumPropagation(throw=False),
        "EP, β = 1": EquilibriumPropagation(1.0, "cost", rtol=1e9, throw=False),
    }
    cases = _cases(config)
    errors = {}
    for name, adjoint in adjoints.items():
        errors[name] = np.array(
            [
                [float(error(c, adjoint, c.scene.target, jnp.asarray(t))) for c in cases]
                for t in config.accuracy.tolerances
            ]
        )
    tolerances = np.asarray(config.accuracy.tolerances)
    means = {name: _geometric_mean(e) for name, e in errors.items()}
    folder.save_table("accuracy", {"tolerance": tolerances} | means)
    folder.save_figure("accuracy", figures.accuracy(tolerances, errors))
    tight, loose = np.argmin(tolerances), np.argmin(np.abs(np.log(tolerances / 1e-3)))
    return {
        f"{name} at tolerance {tolerances[tight]:.0e}": m[tight] for name, m in means.items()
    } | {f"{name} at tolerance {tolerances[loose]:.0e}": m[loose] for name, m in means.items()}


def _beta_scan(config: Config, folder: RunFolder, progress: bool) -> dict[str, Any]:
    """Error of EP against the strength of its nudge, and what a fit makes of it."""
    cases = _cases(config)
    betas = {
        "linear": np.asarray(config.accuracy.betas),
        "cost": np.asarray(config.accuracy.cost_betas),
    }
    errors: dict[str, np.ndarray] = {}
    columns: dict[str, list[Any]] = {"nudge": [], "estimator": [], "beta": [], "error": []}
    for nudge in ("linear", "cost"):
        for centred in (True, False):
            error = _gradient_error(Response())
            adjoints = [
                EquilibriumPropagation(jnp.asarray(b), nudge, centred=centred, throw=False)
                for b in betas[nudge]
            ]
            tolerance = jnp.asarray(1e-11)
            values = [[float(error(c, a, c.settled, tolerance)) for c in cases] for a in adjoints]
            estimator = "centred" if centred else "one-sided"
            errors[f"{nudge}, {estimator}"] = np.array(values)
            columns["nudge"] += [nudge] * len(adjoints)
            columns["estimator"] += [estimator] * len(adjoints)
            columns["beta"] += list(betas[nudge])
            columns["error"] += list(_geometric_mean(np.array(values)))
    batch = stack(_scenes(config, config.paper.relaxation))
    fitted = {}
    for beta in config.accuracy.fitted_betas:
        gradient = config.paper.gradient.model_copy(update={"beta": beta})
        protocol = config.paper.model_copy(update={"gradient": gradient})
        outcome = folder.fit(
            f"beta {beta:g}",
            _problem(batch, protocol, "EP"),
            protocol.fit.build(),
            protocol.fit.epochs,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
        true, inferred = _shape_factors(batch.truth), _shape_factors(outcome.energy)
        fitted[beta] = _recovery(true, inferred, outcome)
    folder.save_table("beta", columns)
    folder.save_figure("beta", figures.beta_scan(betas, errors, fitted))
    best = {f"{name}, smallest error": _geometric_mean(e).min() for name, e in errors.items()}
    return best | {
        f"fit with β = {beta:g}, relative error": m["relative_error_mean"]
        for beta, m in fitted.items()
    }


def _geometric_mean(x: np.ndarray) -> np.ndarray:
    return np.exp(np.mean(np.log(np.maximum(x, 1e-300)), axis=-1))


# --- time and memory -----------------------------------------------------------------------------------


def _scaling(config: Config, folder: RunFolder) -> dict[str, dict[str, Any]]:
    """Time and memory of an epoch against the number of cells."""
    rows: list[dict[str, Any]] = []
    for name in ("equilibrium", "paper"):
        protocol = _protocol(config, name)
        for n_cells in config.scaling.sizes:
            key = jax.random.key(config.seed)
            scene = _scene(config, key, protocol.relaxation.build(), n_cells)
            for method in _measurable(config, n_cells):
                problem = _problem(scene, protocol, method)
                rows.append(
                    {"protocol": name, "cells": n_cells, "method": method}
                    | _measure(problem, config.scaling.epochs)
                )
    folder.save_table("scaling", {key: [row[key] for row in rows] for key in rows[0]})
    folder.save_figure("scaling", figures.scaling(rows))
    return _by_method(rows)


def _measurable(config: Config, n_cells: int) -> Iterable[Method]:
    limits = {"AD": config.scaling.largest_unrolled, "Sen-ID": config.scaling.largest_sensitivity}
    return (m for m in config.methods if n_cells <= limits.get(m, n_cells))


def _measure(problem: InverseProblem[ShapeFactorEnergy], epochs: int) -> dict[str, Any]:
    """Milliseconds of an epoch and of its relaxation alone, and the memory that XLA sets aside."""
    arguments = (problem.energy, problem.tissue)
    forward = jax.jit(lambda energy, tissue: problem(energy, tissue)).lower(*arguments).compile()
    backward = (
        jax.jit(lambda energy, tissue: problem.value_and_gradient(energy, tissue)[:3])
        .lower(*arguments)
        .compile()
    )
    seconds: dict[str, list[float]] = {"forward": [], "epoch": []}
    tissue, p = problem.tissue, jnp.asarray(problem.energy.target_shape_factor)
    for key in jax.random.split(jax.random.key(1), epochs + 1):
        # A change as large as that of an update by ADAM.
        p = p + 1e-3 * jax.random.normal(key, p.shape, p.dtype)
        energy = eqx.tree_at(lambda e: e.target_shape_factor, problem.energy, p)
        for name, function in (("forward", forward), ("epoch", backward)):
            began = time.perf_counter()
            result = jax.block_until_ready(function(energy, tissue))
            seconds[name].append(time.perf_counter() - began)
        tissue = result[1].tissue
    memory = backward.memory_analysis()
    # The first epoch is a warm-up.
    ms = {name: 1e3 * float(np.median(times[1:])) for name, times in seconds.items()}
    return {
        "ms_per_epoch": ms["epoch"],
        "ms_forward": ms["forward"],
        "gradient_over_forward": (ms["epoch"] - ms["forward"]) / ms["forward"],
        "memory_kB": memory.temp_size_in_bytes / 1e3 if memory is not None else np.nan,
    }


def _by_method(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The measurements of each protocol and method."""
    memory = {(row["protocol"], row["cells"], row["method"]): row["memory_kB"] for row in rows}
    metrics: dict[str, dict[str, Any]] = {}
    for row in rows:
        protocol, cells, method = row["protocol"], row["cells"], row["method"]
        group = metrics.setdefault(f"{protocol} {method}", {})
        group[f"{cells} cells, ms per epoch"] = row["ms_per_epoch"]
        group[f"{cells} cells, gradient over forward"] = row["gradient_over_forward"]
        group[f"{cells} cells, memory kB"] = row["memory_kB"]
        if (protocol, cells, "EP") in memory:
            share = row["memory_kB"] / memory[protocol, cells, "EP"]
            group[f"{cells} cells, memory over that of EP"] = share
    return metrics
