"""Compare automatic and implicit differentiation and equilibrium propagation (paper, Figure 2).

Target shape factors are inferred from vertices by automatic differentiation (AD), implicit differentiation
(adjoint state, Adj-ID, and forward sensitivity, Sen-ID) and equilibrium propagation (EP): with the protocol
of the paper, which stops relaxations early, and at converged equilibria, also by Levenberg-Marquardt (LM).
"""

from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from pydantic import Field

import vertax as vx
from experiments._replicates import plot_band, plot_boxes, same_limits
from vertax import inference, plotting, runs

Method = Literal["AD", "Adj-ID", "Sen-ID", "EP"]
GRADIENTS: dict[str, str] = {
    "AD": "unrolled",
    "Adj-ID": "implicit",
    "Sen-ID": "sensitivity",
    "EP": "propagation",
}
MARKERS = {"AD": "o", "Adj-ID": "^", "Sen-ID": "v", "EP": "s", "LM": "D"}
# The colours of the paper, in shades that differ for any colour vision.
COLOURS = dict(zip(MARKERS, ("#0072b2", "#d55e00", "#cc79a7", "#009e73", "#7f7f7f"), strict=True))
TITLES = {"paper": "the paper's protocol", "equilibrium": "true equilibria"}
UNROLLED = runs.RelaxationSection(solver="momentum", learning_rate=3e-3, tolerance=1e-6, max_steps=20_000)


class Protocol(runs.Section):
    """Settings of both levels of the inverse problem."""

    relaxation: runs.RelaxationSection = runs.RelaxationSection()
    """Relaxation of tissues."""
    unrolled: runs.RelaxationSection = UNROLLED
    """The same for AD, which needs a solver of fixed steps."""
    fit: runs.Fitting = runs.Fitting()
    """Fit of the parameters."""
    gradient: runs.Gradient = runs.Gradient(strict=True)
    """Settings of the gradient; `methods` replaces its method."""


class Scenes(runs.ExperimentConfig):
    """The tissues, the methods and both protocols."""

    replicates: int = Field(default=5, ge=2)
    """Independent tissues, fitted as one batch."""
    methods: list[Method] = Field(default=["AD", "Adj-ID", "Sen-ID", "EP"])
    """Ways to differentiate."""
    tissue: runs.TissueSection = runs.TissueSection()
    """The tissues."""
    truth: runs.ShapeFactors = runs.ShapeFactors()
    """Distribution of the true shape factors and of the guesses."""
    paper: Protocol = Protocol()
    """The paper's protocol."""
    equilibrium: Protocol = Protocol()
    """Converged equilibria."""


class Config(Scenes):
    """Configuration of this experiment."""

    least_squares_steps: int = Field(default=25, ge=0)
    """Steps of Levenberg-Marquardt, at converged equilibria; 0 skips it."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Pearson correlations and relative errors by protocol and method."""
    return fit_all(config, "paper", folder, progress) | fit_all(config, "equilibrium", folder, progress)


def fit_all(config: Config, name: str, folder: runs.RunFolder, progress: bool) -> dict[str, Any]:
    """Fit all replicates by all methods of one protocol."""
    protocol: Protocol = getattr(config, name)
    batch = vx.fitting.stack(make_scenes(config, protocol.relaxation))
    options: dict[str, Any] = {"truth": batch.truth, "batched": True, "progress": progress}
    fits: dict[str, vx.Fit] = {}
    for method in config.methods:
        problem, optimiser = make_problem(batch, protocol, method), protocol.fit.build()
        fits[method] = folder.fit(f"{name} {method}", problem, optimiser, protocol.fit.epochs, **options)
    if name == "equilibrium" and config.least_squares_steps:
        problem, solver = make_problem(batch, protocol, "Adj-ID"), optx.LevenbergMarquardt(1e-12, 1e-12)
        fits["LM"] = folder.fit(f"{name} LM", problem, solver, config.least_squares_steps, **options)
    true, initial = shape_factors(batch.truth), shape_factors(batch.guess)
    inferred = {method: shape_factors(fit.energy) for method, fit in fits.items()}
    columns = {"replicate": np.repeat(np.arange(len(true)), true.shape[1]), "true": true.ravel()}
    columns |= {"initial": initial.ravel()} | {m: values.ravel() for m, values in inferred.items()}
    folder.save_table(f"shape_factors_{name}", columns)
    labels = {m: [{"method": m, "replicate": str(k)} for k in range(config.replicates)] for m in fits}
    histories = [runs.history_table(fit.history, *labels[method]) for method, fit in fits.items()]
    folder.save_table(f"history_{name}", runs.concatenate(histories))
    figure = plot_inference(fits, true, initial, inferred, title=TITLES[name])
    folder.save_figure(f"inference_{name}", figure)
    return {f"{name} {method}": recovery(true, fit) for method, fit in fits.items()}


def make_scene(config: Scenes, key: Any, response: Any, n_cells: int | None = None) -> inference.Scene:
    """A scene of the configured size or of another one."""
    tissue = config.tissue.model_dump() | ({} if n_cells is None else {"n_cells": n_cells})
    return inference.shape_factor_scene(key=key, response=response, **tissue, **config.truth.model_dump())


def make_scenes(config: Scenes, relaxation: runs.RelaxationSection, n_cells: int | None = None) -> list[Any]:
    """One scene per replicate; start and target have one topology, because vertices are compared by index."""
    response, scenes = relaxation.build(), []
    for key in jax.random.split(jax.random.key(config.seed), 20 * config.replicates):
        scene = make_scene(config, key, vx.Relaxation(), n_cells)
        if inference.same_neighbours(scene.initial, scene.target):
            initial = response(scene.target, scene.guess, throw=False).tissue
            scenes.append(eqx.tree_at(lambda s: s.initial, scene, initial))
        if len(scenes) == config.replicates:
            return scenes
    raise ValueError(
        f"Only {len(scenes)} of {20 * config.replicates} guesses relax into the topology of their "
        "target: choose a smaller truth.deviation or truth.mean."
    )


def make_problem(scene: inference.Scene, protocol: Protocol, method: str) -> vx.InverseProblem:
    """The inverse problem of a scene, or of a batch of scenes."""
    relaxation = protocol.unrolled if method == "AD" else protocol.relaxation
    gradient = protocol.gradient.model_copy(update={"method": GRADIENTS[method]})
    options: Any = {"adjoint": gradient.build(), "response": relaxation.build()}
    return vx.InverseProblem(scene.initial, scene.guess, vx.costs.VertexDistance(scene.target), **options)


def shape_factors(energy: Any) -> np.ndarray:
    """Target shape factors."""
    return np.asarray(energy.target_shape_factor, float)


def recovery(true: np.ndarray, fit: vx.Fit) -> dict[str, Any]:
    """The metrics of a batch of fits."""
    history, inferred = fit.history, shape_factors(fit.energy)
    correlation, error = inference.pearson(true, inferred), inference.relative_error(true, inferred)
    accurate = np.flatnonzero(history.relative_error.max(axis=1) < 1e-6)
    return {
        "pearson_mean": correlation.mean(),
        "pearson_min": correlation.min(),
        "relative_error_mean": error.mean(),
        "relative_error_max": error.max(),
        "cost_mean": np.mean(fit.cost),
        "converged_fraction": history.converged.mean(),
        "gradient_residual": np.median(history.gradient_residual),
        "num_t1": history.num_t1.sum(),
        "epochs": len(history.cost),
        "ms_per_epoch_of_batch": 1e3 * np.median(history.seconds[1:]),
        "pearson": correlation,
        "relative_error": error,
        "epochs_to_1e-6": int(accurate[0]) if accurate.size else None,
    }


@plotting.house_style()
def plot_inference(fits: Any, true: np.ndarray, initial: np.ndarray, inferred: Any, *, title: str) -> Any:
    """Scatter plots, curves over epochs and box plots over replicates, by method."""
    figure, ((start, end, cost), (error, correlation, final)) = plotting.new_figure(2, 3)
    figure.suptitle(title, fontsize=9)
    style: dict[str, Any] = {"name": "$p_0$", "label": "guess", "colour": "0.6"}
    plotting.plot_recovery(true.ravel(), initial.ravel(), ax=start, **style)
    for method, values in inferred.items():
        style |= {"label": method, "colour": COLOURS[method], "marker": MARKERS[method]}
        plotting.plot_recovery(true.ravel(), values.ravel(), ax=end, **style)
    same_limits((start, end))
    start.set_title("epoch 0")
    end.set_title("best epoch")
    for ax, name, label in ((cost, "cost", "cost (v2v)"), (error, "relative_error", "relative error")):
        for method, fit in fits.items():
            curves = getattr(fit.history, name)
            plot_band(curves, ax, log=True, label=method, colour=COLOURS[method])
        ax.set(xlabel="epoch", ylabel=label)
    cost.legend(ncols=2, columnspacing=0.8)
    # A logarithmic axis shows no zero, which 1 - r is up to rounding.
    distances = {m: np.maximum(1 - inference.pearson(true, p), 1e-16) for m, p in inferred.items()}
    errors = {m: inference.relative_error(true, p) for m, p in inferred.items()}
    plot_boxes(distances, correlation, colours=COLOURS, log=True)
    correlation.set_ylabel("1 − Pearson $r$ at the end")
    plot_boxes(errors, final, colours=COLOURS, log=True)
    final.set_ylabel("relative error at the end")
    return figure
