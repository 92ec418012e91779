"""Accuracy of each gradient: as the relaxation is cut short, and as the nudge of EP varies."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vertax.adjoints import (
    AbstractAdjoint,
    AutomaticDifferentiation,
    EquilibriumPropagation,
    ImplicitDifferentiation,
)
from vertax.costs import VertexDistance
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import InverseProblem, stack
from vertax.inference import Scene
from vertax.relax import Relaxation as Response
from vertax.runs import Relaxation, RunFolder

from . import figures
from .problems import Config, problem_of, recovery, scenes_of, shape_factors


class _Case(eqx.Module):
    """A relaxation to differentiate, and the right answer."""

    scene: Scene
    reference: jax.Array
    settled: Any


def _cases(config: Config) -> list[_Case]:
    cases = []
    for scene in scenes_of(config, Relaxation(), config.accuracy.n_cells):
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
            response=settings,
        )
        gradient = problem.value_and_gradient(throw=False).gradient
        difference = gradient.target_shape_factor - case.reference
        return jnp.linalg.norm(difference) / jnp.linalg.norm(case.reference)

    return error


def accuracy(config: Config, folder: RunFolder) -> dict[str, Any]:
    """Error of each gradient against the force at which the relaxation stopped."""
    # A first-order solver ends just below the tolerance; Newton's method would overshoot it.
    relaxation = config.equilibrium.unrolled.model_copy(
        update={"max_steps": 50_000, "consecutive_steps": 1}
    )
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


def beta_scan(config: Config, folder: RunFolder, progress: bool) -> dict[str, Any]:
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
    batch = stack(scenes_of(config, config.paper.relaxation))
    fitted = {}
    for beta in config.accuracy.fitted_betas:
        gradient = config.paper.gradient.model_copy(update={"beta": beta})
        protocol = config.paper.model_copy(update={"gradient": gradient})
        outcome = folder.fit(
            f"beta {beta:g}",
            problem_of(batch, protocol, "EP"),
            protocol.fit.build(),
            protocol.fit.epochs,
            truth=batch.truth,
            batched=True,
            progress=progress,
        )
        true, inferred = shape_factors(batch.truth), shape_factors(outcome.energy)
        fitted[beta] = recovery(true, inferred, outcome)
    folder.save_table("beta", columns)
    folder.save_figure("beta", figures.beta_scan(betas, errors, fitted))
    best = {f"{name}, smallest error": _geometric_mean(e).min() for name, e in errors.items()}
    return best | {
        f"fit with β = {beta:g}, relative error": m["relative_error_mean"]
        for beta, m in fitted.items()
    }


def _geometric_mean(x: np.ndarray) -> np.ndarray:
    return np.exp(np.mean(np.log(np.maximum(x, 1e-300)), axis=-1))
