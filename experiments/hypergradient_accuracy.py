"""Errors of hypergradients against the residual force and against the nudge of equilibrium propagation.

The reference is the implicit function theorem with the dense Hessian at an equilibrium of forces below 1e-12.
A relaxation that stops early shows why the protocol of the paper limits each method; fits with several nudges
show the consequence for the parameters (paper, Extended Figure 1).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

import vertax as vx
from experiments import benchmark_adjoints as benchmark
from experiments._replicates import same_limits
from experiments._shared import columns
from vertax import plotting, runs


class Config(benchmark.Scenes):
    """Configuration of this experiment."""

    tolerances: list[float] = Field(default=[1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
    """Largest forces at which the relaxation stops."""
    betas: list[float] = Field(default=[1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
    """Strengths of the linear nudge, at converged equilibria."""
    cost_betas: list[float] = Field(default=[1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0])
    """Strengths of the nudge by the cost, energy per cost."""
    fitted_betas: list[float] = Field(default=[1e-1, 1.0, 10.0])
    """Strengths of the nudge in fits with the paper's protocol."""


class Case(eqx.Module):
    """A relaxation to differentiate, its hypergradient and its end."""

    scene: vx.inference.Scene
    reference: jax.Array
    settled: Any


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Geometric means of the errors over replicates, and relative errors of the fits."""
    scenes = benchmark.make_scenes(config, runs.RelaxationSection())
    cases = [make_case(scene) for scene in scenes]
    return {
        "hypergradient": scan_tolerances(config, cases, folder),
        "beta": scan_betas(config, cases, folder, progress),
    }


def make_case(scene: vx.inference.Scene) -> Case:
    """A relaxation from the target to the tissue of the guess, and its hypergradient by dense algebra."""
    settled = vx.Relaxation(transitions=None, tolerance=1e-12)(scene.target, scene.guess).tissue
    cost, shape = vx.costs.VertexDistance(scene.target), settled.vertices.shape
    place = lambda y: settled.with_configuration(y.reshape(shape))
    y = settled.vertices.ravel()
    pull = jax.grad(lambda y: cost(place(y), scene.guess))(y)
    hessian = jax.jit(jax.hessian(lambda y: scene.guess(place(y))))(y)
    force = lambda p: jax.grad(lambda y: vx.energies.ShapeFactorEnergy(p)(place(y)))(y)
    mixed = jax.jit(jax.jacobian(force))(scene.guess.target_shape_factor)
    inverse = jnp.linalg.pinv(hessian, rtol=1e-10, hermitian=True)
    return Case(scene, -mixed.T @ inverse @ pull, settled)


def gradient_error(response: vx.Relaxation) -> Any:
    """The relative error of a hypergradient as a function of case, adjoint, start and tolerance."""

    @eqx.filter_jit
    def error(case: Case, adjoint: Any, start: Any, tolerance: Any) -> jax.Array:
        settings: Any = dataclasses.replace(response, transitions=None, tolerance=tolerance)
        cost = vx.costs.VertexDistance(case.scene.target)
        problem = vx.InverseProblem(start, case.scene.guess, cost, adjoint=adjoint, response=settings)
        gradient = problem.value_and_gradient(throw=False).gradient.target_shape_factor
        return jnp.linalg.norm(gradient - case.reference) / jnp.linalg.norm(case.reference)

    return error


def geometric_mean(values: Any) -> Any:
    """The geometric mean over the last axis."""
    return np.exp(np.mean(np.log(np.maximum(values, 1e-300)), axis=-1))


def scan_tolerances(config: Config, cases: list[Case], folder: runs.RunFolder) -> dict[str, Any]:
    """The error of each adjoint against the force at which the relaxation stops."""
    # A first-order solver stops just below the tolerance; Newton's method would overshoot it.
    update = {"max_steps": 50_000, "consecutive_steps": 1}
    error = gradient_error(config.equilibrium.unrolled.model_copy(update=update).build())
    adjoints = {
        "AD": vx.AutomaticDifferentiation(throw=False),
        # As in common practice: AD through the steps of the tissue only, nudged tissues at its tolerance.
        "AD, no step more": vx.AutomaticDifferentiation(rtol=1e9, throw=False),
        "Adj-ID": vx.ImplicitDifferentiation(throw=False),
        "Sen-ID": vx.ImplicitDifferentiation("sensitivity", throw=False),
        "EP": vx.EquilibriumPropagation(throw=False),
        "EP, β = 1": vx.EquilibriumPropagation(1.0, "cost", rtol=1e9, throw=False),
    }
    tolerances = np.asarray(config.tolerances)
    row = lambda adjoint, t: [float(error(c, adjoint, c.scene.target, jnp.asarray(t))) for c in cases]
    errors = {n: np.array([row(adjoint, t) for t in config.tolerances]) for n, adjoint in adjoints.items()}
    means = {name: geometric_mean(values) for name, values in errors.items()}
    folder.save_table("accuracy", {"tolerance": tolerances} | means)
    folder.save_figure("accuracy", plot_accuracy(tolerances, errors))
    chosen = (np.argmin(tolerances), np.argmin(np.abs(np.log(tolerances / 1e-3))))
    return {f"{n} at tolerance {tolerances[k]:.0e}": m[k] for k in chosen for n, m in means.items()}


def scan_betas(config: Config, cases: list[Case], folder: runs.RunFolder, progress: bool) -> dict[str, Any]:
    """The error of equilibrium propagation against the strength of its nudge, and fits with it."""
    betas = {"linear": np.asarray(config.betas), "cost": np.asarray(config.cost_betas)}
    errors: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for nudge, estimator in ((n, e) for n in ("linear", "cost") for e in ("centred", "one-sided")):
        error = gradient_error(vx.Relaxation())
        options: Any = {"nudge": nudge, "centred": estimator == "centred", "throw": False}
        values = np.zeros((len(betas[nudge]), len(cases)))
        for k, beta in enumerate(betas[nudge]):
            adjoint = vx.EquilibriumPropagation(jnp.asarray(beta), **options)
            values[k] = [float(error(c, adjoint, c.settled, jnp.asarray(1e-11))) for c in cases]
            mean = geometric_mean(values[k])
            rows.append({"nudge": nudge, "estimator": estimator, "beta": beta, "error": mean})
        errors[f"{nudge}, {estimator}"] = values
    batch = vx.fitting.stack(benchmark.make_scenes(config, config.paper.relaxation))
    fitted = {}
    for beta in config.fitted_betas:
        gradient = config.paper.gradient.model_copy(update={"beta": beta})
        protocol = config.paper.model_copy(update={"gradient": gradient})
        problem, optimiser = benchmark.make_problem(batch, protocol, "EP"), protocol.fit.build()
        options = {"truth": batch.truth, "batched": True, "progress": progress}
        fit = folder.fit(f"beta {beta:g}", problem, optimiser, protocol.fit.epochs, **options)
        fitted[beta] = benchmark.recovery(benchmark.shape_factors(batch.truth), fit)
    folder.save_table("beta", columns(rows))
    folder.save_figure("beta", plot_betas(betas, errors, fitted))
    smallest = {f"{name}, smallest error": geometric_mean(e).min() for name, e in errors.items()}
    name = "fit with β = {:g}, relative error"
    return smallest | {name.format(beta): m["relative_error_mean"] for beta, m in fitted.items()}


@plotting.house_style()
def plot_accuracy(tolerances: np.ndarray, errors: dict[str, np.ndarray]) -> Any:
    """Error of each hypergradient against the tolerance of the relaxation."""
    figure, ((ax,),) = plotting.new_figure(width=4.8, height=2.8)
    for name, values in errors.items():
        method, _, variant = name.partition(",")
        # The two forms of ID agree to rounding: a larger marker shows both.
        style: Any = {"marker": benchmark.MARKERS[method], "ms": 6 if method == "Sen-ID" else 3.5}
        style |= {"ls": "--", "mfc": "white"} if variant else {}
        ax.plot(tolerances, geometric_mean(values), color=benchmark.COLOURS[method], label=name, **style)
    ax.set(xscale="log", yscale="log", xlabel="largest force at the end of the relaxation")
    ax.set_ylabel("relative error of the hypergradient")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


@plotting.house_style()
def plot_betas(betas: dict[str, np.ndarray], errors: dict[str, np.ndarray], fitted: dict[float, Any]) -> Any:
    """Error of equilibrium propagation against the strength of the nudge, and fits with it."""
    figure, ((linear, cost, right),) = plotting.new_figure(1, 3, height=2.5)
    colour, label = benchmark.COLOURS["EP"], r"$\beta$, energy per cost"
    for ax, nudge, name in ((linear, "linear", r"$\beta$, relative force"), (cost, "cost", label)):
        for style, estimator in (("o-", "centred"), ("s--", "one-sided")):
            values = geometric_mean(errors[f"{nudge}, {estimator}"])
            ax.plot(betas[nudge], values, style, ms=3, color=colour, label=estimator)
        ax.set(xscale="log", yscale="log", xlabel=name, title=f"nudge: {nudge}")
    same_limits((linear, cost), x=False)
    linear.set_ylabel("relative error of the hypergradient")
    linear.legend()
    for k, recovery in enumerate(fitted.values()):
        points = recovery["relative_error"]
        right.plot(np.full(len(points), k), points, "o", ms=3, color=colour)
    right.set_xticks(range(len(fitted)), [f"{beta:g}" for beta in fitted])
    right.set(yscale="log", xlabel=label, ylabel="relative error of parameters")
    right.set_title("fits, the paper's protocol")
    return figure
