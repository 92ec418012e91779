"""Find the line tensions of a foam from its shape, with Surface Evolver as the only forward model.

A periodic foam with elastic areas (the paper's energy E2) rests under tensions drawn at random. From where
its vertices are they are found again, by the Levenberg-Marquardt method: some combinations of tensions hardly
move any vertex, and a gradient alone would take thousands of epochs. Its Jacobian comes from equilibrium
propagation: the program relaxes the foam once an epoch, and twice under a weak force for each coordinate of a
vertex. The same fit with vertax's own equilibrium, and implicit derivatives, stands beside it.

Or the foam is that of a dump of Surface Evolver, with its arcs and the areas that it holds; the forward model
is then the program alone.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from pydantic import Field, field_validator

from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.costs import AbstractLeastSquaresCost, VertexDistance
from vertax.energies import AbstractEnergy, AreaElasticity, LineTension
from vertax.external import External, SurfaceEvolver
from vertax.fitting import InverseProblem
from vertax.inference import pearson
from vertax.initialise import periodic_voronoi
from vertax.io import read_surface_evolver
from vertax.mesh import Tissue
from vertax.relax import Relaxation
from vertax.runs import (
    ConfigError,
    ExperimentConfig,
    RunFolder,
    Section,
    TissueSection,
    file_name,
    history_columns,
)

from . import figures


class Foam(Section):
    """The foam; lengths are measured in the root of the mean cell area."""

    mean: float = Field(default=0.3, gt=0)
    """Mean line tension, known to the first guess."""
    deviation: float = Field(default=0.03, ge=0)
    """Standard deviation of the tensions of its edges."""
    stiffness: float = Field(default=10.0, gt=0)
    """Stiffness of the areas, known."""
    file: str = "synthetic"
    """A dump of Surface Evolver whose foam it is, with its tensions, arcs and areas; or synthetic, a foam
    that is drawn."""
    at_rest: bool = True
    """Let the foam of a file come to rest under its true tensions first; otherwise its shape is taken as it
    is, whether at rest or not."""

    _not_empty = field_validator("file")(file_name)


class Program(Section):
    """Surface Evolver."""

    command: str = "evolver"
    """The program; the Debian package evolver-nox has it."""
    timeout: float = Field(default=60.0, gt=0)
    """Seconds after which a run is ended."""
    pieces: int = Field(default=3, ge=2)
    """Straight pieces of each arc, of a foam from a file."""


class Fit(Section):
    """How the tensions are fitted: by least squares."""

    epochs: int = Field(default=16, ge=1)
    """Steps of the Levenberg-Marquardt method, at most."""
    tolerance: float = Field(default=1e-8, gt=0)
    """Relative change of the tensions, and of the cost, at which it ends."""

    def build(self) -> optx.LevenbergMarquardt:
        """The least-squares solver."""
        return optx.LevenbergMarquardt(rtol=self.tolerance, atol=self.tolerance)


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    tissue: TissueSection = TissueSection(n_cells=20, lloyd_steps=1)
    """The tissue."""
    foam: Foam = Foam()
    """Its energy."""
    program: Program = Program()
    """The forward model."""
    fit: Fit = Fit()
    """How the tensions are fitted."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: for both forward models the relative error of the tensions before and after,
    their correlation with the true ones, and seconds; of the program also its runs, and the seconds in them;
    and how far the vertices of a foam from a file went on their way to rest (root mean square).

    **Raises:**

    - `ConfigError` if Surface Evolver is not installed, with how to install it.
    - `FitError` if a fit cannot go on.
    """
    if shutil.which(config.program.command) is None:
        raise ConfigError(
            f"There is no program {config.program.command!r} here: this experiment needs Surface Evolver. "
            "Install it by apt-get install evolver-nox, or set program.command."
        )
    case = _drawn(config) if config.foam.file == "synthetic" else _of_file(config)
    target, true, ways = case.target, case.true, case.ways
    external = ways["Surface Evolver"][0]
    # (Where the program has run before: in a test, say, or to bring the foam to rest.)
    runs, seconds = external.ledger.runs, external.ledger.seconds
    fits, metrics = {}, {"n_edges": target.n_edges, **case.metrics}
    for name, (response, adjoint) in ways.items():
        guess = case.energy(jnp.full_like(true, case.mean))
        fixed = jax.tree.map(lambda _: False, guess)
        fitted = eqx.tree_at(lambda e: e.terms[1].tension, fixed, True)
        problem = InverseProblem(
            target, guess, case.cost, fitted, response=response, adjoint=adjoint
        )
        fit = folder.fit(
            name,
            problem,
            config.fit.build(),
            config.fit.epochs,
            truth=case.energy(true),
            progress=progress,
        )
        fits[name] = fit
        history, label = fit.history, name.split()[-1].lower()
        folder.save_table(f"history_{label}", history_columns(history))
        found = np.asarray(_tensions(fit.energy))
        best = int(fit.best_epoch)
        metrics |= {
            f"relative_error_initial_{label}": history.relative_error[0],
            f"relative_error_{label}": history.relative_error[best],
            f"pearson_{label}": pearson(found, np.asarray(true)),
            f"cost_{label}": history.cost[best],
            f"seconds_{label}": history.seconds.sum(),
            f"seconds_of_an_epoch_{label}": np.median(history.seconds),
        }
    metrics |= {
        "runs_of_the_program": external.ledger.runs - runs,
        "seconds_in_the_program": external.ledger.seconds - seconds,
    }
    tensions = {name: np.asarray(_tensions(fit.energy)) for name, fit in fits.items()}
    columns = {"edge": np.arange(target.n_edges), "true": np.asarray(true)}
    columns |= {f"found_{name.split()[-1].lower()}": values for name, values in tensions.items()}
    folder.save_table("edges", columns)
    folder.save_tissue("target", target)
    errors = {name: fit.history.relative_error for name, fit in fits.items()}
    folder.save_figure("recovery", figures.recovery(target, np.asarray(true), tensions, errors))
    return metrics


class Case(NamedTuple):
    """What is looked for, and by which ways."""

    target: Tissue
    """The shape that is known."""
    true: Float[Array, " edges"]
    mean: float
    energy: Callable[[Float[Array, " edges"]], AbstractEnergy]
    """The energy with some tensions."""
    cost: AbstractLeastSquaresCost
    ways: Mapping[str, tuple[Any, AbstractAdjoint]]
    """Forward models, and how to differentiate through them."""
    metrics: Mapping[str, float] = MappingProxyType({})
    """What else there is to say of it."""


def _drawn(config: Config) -> Case:
    """A periodic foam."""
    keys = jax.random.split(jax.random.key(config.seed))
    n_cells, lloyd_steps = config.tissue.n_cells, config.tissue.lloyd_steps
    drawn = periodic_voronoi(n_cells, key=keys[0], lloyd_steps=lloyd_steps)
    noise = jax.random.normal(keys[1], (drawn.n_edges,))
    true = config.foam.mean + config.foam.deviation * noise

    def energy(tensions: Float[Array, " edges"]) -> AbstractEnergy:
        return AreaElasticity(config.foam.stiffness, 1.0) + LineTension(tensions)

    # T1 transitions happen here and nowhere else.
    target = Relaxation()(drawn, energy(true)).tissue
    program = SurfaceEvolver(command=config.program.command, timeout=config.program.timeout)
    ways = {
        "Surface Evolver": (External(program), EquilibriumPropagation()),
        "vertax": (Relaxation(transitions=None, contact_range=None), ImplicitDifferentiation()),
    }
    return Case(target, true, config.foam.mean, energy, VertexDistance(target), ways)


def _of_file(config: Config) -> Case:
    """A free foam of arcs, whose areas are held."""
    foam = read_surface_evolver(config.foam.file)
    program = SurfaceEvolver(
        command=config.program.command,
        areas="fixed",
        pieces=config.program.pieces,
        timeout=config.program.timeout,
    )
    mean = float(foam.tensions.mean())
    size = float(jnp.sqrt(foam.target_areas.mean()))
    external = External(program, slope="program", stiffness=mean / size)

    def energy(tensions: Float[Array, " edges"]) -> AbstractEnergy:
        # The areas are held, so their stiffness does not matter.
        return AreaElasticity(1.0, foam.target_areas) + LineTension(tensions)

    target, moved = foam.tissue, {}
    if config.foam.at_rest:
        target = external(target, energy(foam.tensions)).tissue
        way = jnp.sum((target.vertices - foam.tissue.vertices) ** 2, axis=1)
        moved = {"moved_to_rest": float(jnp.sqrt(jnp.mean(way)))}
    # A gradient that is one-sided is as good for a step, and takes half the runs.
    ways = {"Surface Evolver": (external, EquilibriumPropagation(centred=False))}
    cost = Shape(target, jnp.asarray(size), jnp.asarray(mean))
    return Case(target, foam.tensions, mean, energy, cost, ways, moved)


class Shape(AbstractLeastSquaresCost):
    """Where vertices are and how edges bend; and the mean tension, which no shape tells."""

    target: Tissue
    size: Float[Array, ""]
    mean: Float[Array, ""]

    def residuals(self, tissue: Tissue, energy: Any) -> Float[Array, " residuals"]:
        """Half the sum of their squares is the cost."""
        vertices = (tissue.vertices - self.target.vertices).ravel() / self.size
        angles = tissue.edge_angles - self.target.edge_angles
        scale = jnp.mean(_tensions(energy)) / self.mean - 1
        return jnp.concatenate([vertices, angles, scale[None]]) / jnp.sqrt(vertices.size)


def _tensions(energy: Any) -> Float[Array, " edges"]:
    """The tensions of an energy of this experiment."""
    return energy.terms[1].tension
