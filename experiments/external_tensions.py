"""Find the line tensions of a foam from its shape, with Surface Evolver as the forward model.

A periodic foam with elastic areas (the paper's energy E2) is at equilibrium under random tensions. The
tensions are recovered from the vertices by the Levenberg-Marquardt method, because some combinations of
tensions hardly move any vertex and a gradient would take thousands of epochs. The Jacobian comes from
equilibrium propagation: Surface Evolver relaxes the foam once per epoch, and twice under a weak force for
each coordinate of a vertex. The same fit with the equilibrium of vertax and implicit derivatives is the
comparison. Or the foam is a dump of Surface Evolver, with arcs and fixed areas; then the program is the only
forward model.
"""

import shutil
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from pydantic import Field

import vertax as vx
from experiments._replicates import series_colours
from vertax import plotting, runs
from vertax.energies import AreaElasticity, LineTension


class Foam(runs.Section):
    """The foam; lengths are in units of the root of the mean cell area."""

    mean: float = Field(default=0.3, gt=0)
    """Mean line tension, which is the first guess."""
    deviation: float = Field(default=0.03, ge=0)
    """Standard deviation of the tensions of edges."""
    stiffness: float = Field(default=10.0, gt=0)
    """Stiffness of the areas, not fitted."""
    file: str = Field(default="synthetic", min_length=1)
    """A dump of Surface Evolver with tensions, arcs and areas; or synthetic, for a random foam."""
    at_rest: bool = True
    """Relax the foam of a file under its true tensions first; otherwise its shape is the target as it is."""


class Program(runs.Section):
    """Surface Evolver."""

    command: str = "evolver"
    """The program; the Debian package evolver-nox has it."""
    timeout: float = Field(default=60.0, gt=0)
    """Largest duration of a run in seconds."""
    pieces: int = Field(default=3, ge=2)
    """Straight pieces of each arc, for a foam from a file."""


class Fit(runs.Section):
    """The least-squares fit of the tensions."""

    epochs: int = Field(default=16, ge=1)
    """Largest number of Levenberg-Marquardt steps."""
    tolerance: float = Field(default=1e-8, gt=0)
    """Relative change of tensions and cost at which the fit ends."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    tissue: runs.TissueSection = runs.TissueSection(n_cells=20, lloyd_steps=1)
    """The tissue."""
    foam: Foam = Foam()
    """Its energy."""
    program: Program = Program()
    """The forward model."""
    fit: Fit = Fit()
    """The fit."""


class Case(NamedTuple):
    """Target, true tensions, their mean, energy of tensions, cost, forward models by name, and metrics."""

    target: vx.Tissue
    true: Any
    mean: float
    energy: Any
    cost: Any
    models: dict[str, tuple[Any, Any]]
    metrics: dict[str, float]


class Shape(vx.costs.AbstractLeastSquaresCost):
    """Differences of vertices and angles of arcs; and of the mean tension, on which no shape depends."""

    target: vx.Tissue
    size: jax.Array
    mean: jax.Array

    def residuals(self, tissue: vx.Tissue, energy: Any) -> jax.Array:
        vertices = (tissue.vertices - self.target.vertices).ravel() / self.size
        angles = tissue.edge_angles - self.target.edge_angles
        scale = jnp.mean(energy.terms[1].tension) / self.mean - 1
        return jnp.concatenate([vertices, angles, scale[None]]) / jnp.sqrt(vertices.size)


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By forward model: errors of the tensions, correlations and seconds; runs and seconds of the program."""
    if shutil.which(config.program.command) is None:
        raise runs.ConfigError(
            f"There is no program {config.program.command!r} here: this experiment needs Surface Evolver. "
            "Install it by apt-get install evolver-nox, or set program.command."
        )
    case = random_foam(config) if config.foam.file == "synthetic" else foam_of_file(config)
    true, external = np.asarray(case.true), case.models["Surface Evolver"][0]
    # The program also ran to relax the target.
    first_runs, first_seconds = external.ledger.runs, external.ledger.seconds
    tensions, errors, metrics = {}, {}, {"n_edges": case.target.n_edges, **case.metrics}
    table = {"edge": np.arange(case.target.n_edges), "true": true}
    for name, (response, adjoint) in case.models.items():
        guess = case.energy(jnp.full_like(case.true, case.mean))
        fitted = eqx.tree_at(lambda e: e.terms[1].tension, jax.tree.map(lambda _: False, guess), True)
        levels: Any = {"response": response, "adjoint": adjoint}
        problem = vx.InverseProblem(case.target, guess, case.cost, fitted, **levels)
        solver = optx.LevenbergMarquardt(rtol=config.fit.tolerance, atol=config.fit.tolerance)
        options: Any = {"truth": case.energy(case.true), "progress": progress}
        fit = folder.fit(name, problem, solver, config.fit.epochs, **options)
        history, label, best = fit.history, name.split()[-1].lower(), int(fit.best_epoch)
        folder.save_table(f"history_{label}", runs.history_table(history))
        tensions[name] = inferred = np.asarray(fit.energy.terms[1].tension)
        errors[name], table[f"found_{label}"] = history.relative_error, inferred
        metrics |= {
            f"relative_error_initial_{label}": history.relative_error[0],
            f"relative_error_{label}": history.relative_error[best],
            f"pearson_{label}": vx.inference.pearson(inferred, true),
            f"cost_{label}": history.cost[best],
            f"seconds_{label}": history.seconds.sum(),
            f"seconds_of_an_epoch_{label}": np.median(history.seconds),
        }
    folder.save_table("edges", table)
    folder.save_tissue("target", case.target)
    folder.save_figure("recovery", plot_recovery(case.target, true, tensions, errors))
    return metrics | {
        "runs_of_the_program": external.ledger.runs - first_runs,
        "seconds_in_the_program": external.ledger.seconds - first_seconds,
    }


def random_foam(config: Config) -> Case:
    """A periodic foam at equilibrium; the fits keep its topology."""
    keys, foam = jax.random.split(jax.random.key(config.seed)), config.foam
    drawn = vx.initialise.periodic_voronoi(key=keys[0], **config.tissue.model_dump())
    true = foam.mean + foam.deviation * jax.random.normal(keys[1], (drawn.n_edges,))
    energy = lambda tensions: AreaElasticity(foam.stiffness, 1.0) + LineTension(tensions)
    target = vx.Relaxation()(drawn, energy(true)).tissue
    settings = {"command": config.program.command, "timeout": config.program.timeout}
    program = vx.External(vx.external.SurfaceEvolver(**settings))
    fixed = vx.Relaxation(transitions=None, contact_range=None)
    models: dict[str, Any] = {"Surface Evolver": (program, vx.EquilibriumPropagation())}
    models |= {"vertax": (fixed, vx.ImplicitDifferentiation())}
    return Case(target, true, foam.mean, energy, vx.costs.VertexDistance(target), models, {})


def foam_of_file(config: Config) -> Case:
    """A free foam of arcs with fixed areas; their stiffness has no effect."""
    foam = vx.io.read_surface_evolver(config.foam.file)
    program = vx.external.SurfaceEvolver(areas="fixed", **config.program.model_dump())
    mean, size = float(foam.tensions.mean()), float(jnp.sqrt(foam.target_areas.mean()))
    external = vx.External(program, slope="program", stiffness=mean / size)
    energy = lambda tensions: AreaElasticity(1.0, foam.target_areas) + LineTension(tensions)
    target, metrics = foam.tissue, {}
    if config.foam.at_rest:
        target = external(target, energy(foam.tensions)).tissue
        squared = jnp.sum((target.vertices - foam.tissue.vertices) ** 2, axis=1)
        metrics["moved_to_rest"] = float(jnp.sqrt(jnp.mean(squared)))
    # One-sided differences need half of the runs, and are as good for a least-squares step.
    models: dict[str, Any] = {"Surface Evolver": (external, vx.EquilibriumPropagation(centred=False))}
    cost = Shape(target, jnp.asarray(size), jnp.asarray(mean))
    return Case(target, foam.tensions, mean, energy, cost, models, metrics)


@plotting.house_style()
def plot_recovery(target: vx.Tissue, true: np.ndarray, tensions: Any, errors: Any) -> Any:
    """The foam, tensions against the true ones, and errors by epoch, for each forward model."""
    figure, (axes,) = plotting.new_figure(1, 3, width=[2.3, 2.3, 2.7], height=2.4, room=0.7)
    plotting.plot_tissues({"the foam": target}, axes=axes[:1], edges=[true], edge_label="true tension")
    axes[1].axline((true.mean(), true.mean()), slope=1, color=plotting.INK, lw=0.7)
    styles: Any = ({"marker": "o", "mfc": "none"}, {"marker": "x"})
    for style, line, (name, colour) in zip(
        styles, ("-", (0, (3, 3))), series_colours(tensions).items(), strict=False
    ):
        axes[1].plot(true, tensions[name], ls="", ms=4, mew=0.8, color=colour, label=name, **style)
        axes[2].semilogy(errors[name], color=colour, ls=line, label=name)
    axes[1].set(xlabel="true tension", ylabel="tension found")
    axes[2].set(xlabel="epoch", ylabel="mean relative error")
    axes[2].legend()
    return figure
