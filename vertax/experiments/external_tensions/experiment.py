"""Find the line tensions of a foam from its shape, with Surface Evolver as the only forward model.

A periodic foam with elastic areas (the paper's energy E2) rests under tensions drawn at random. From where
its vertices are they are found again, by the Levenberg-Marquardt method: some combinations of tensions hardly
move any vertex, and a gradient alone would take thousands of epochs. Its Jacobian comes from equilibrium
propagation: the program relaxes the foam once an epoch, and twice under a weak force for each coordinate of a
vertex. The same fit with vertax's own equilibrium, and implicit derivatives, stands beside it.
"""

from __future__ import annotations

import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from pydantic import Field

from vertax.adjoints import EquilibriumPropagation, ImplicitDifferentiation
from vertax.costs import VertexDistance
from vertax.energies import AbstractEnergy, AreaElasticity, LineTension
from vertax.fitting import InverseProblem
from vertax.inference import pearson
from vertax.initialise import periodic_voronoi
from vertax.responses import External, Relaxation, SurfaceEvolver
from vertax.runs import (
    ConfigError,
    ExperimentConfig,
    RunFolder,
    Section,
    TissueSection,
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


class Program(Section):
    """Surface Evolver."""

    command: str = "evolver"
    """The program; the Debian package evolver-nox has it."""
    timeout: float = Field(default=60.0, gt=0)
    """Seconds after which a run is ended."""


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
    their correlation with the true ones, and seconds; of the program also its runs, and the seconds in them.

    **Raises:**

    - `ConfigError` if Surface Evolver is not installed, with how to install it.
    - `FitError` if a fit cannot go on.
    """
    if shutil.which(config.program.command) is None:
        raise ConfigError(
            f"There is no program {config.program.command!r} here: this experiment needs Surface Evolver. "
            "Install it by apt-get install evolver-nox, or set program.command."
        )
    keys = jax.random.split(jax.random.key(config.seed))
    n_cells, lloyd_steps = config.tissue.n_cells, config.tissue.lloyd_steps
    drawn = periodic_voronoi(n_cells, key=keys[0], lloyd_steps=lloyd_steps)
    noise = jax.random.normal(keys[1], (drawn.n_edges,))
    true = config.foam.mean + config.foam.deviation * noise

    def energy_of(tensions: Float[Array, " edges"]) -> AbstractEnergy:
        return AreaElasticity(config.foam.stiffness, 1.0) + LineTension(tensions)

    # T1 transitions happen here and nowhere else.
    target = Relaxation()(drawn, energy_of(true)).tissue
    program = SurfaceEvolver(command=config.program.command, timeout=config.program.timeout)
    external = External(program)
    ways = {
        "Surface Evolver": (external, EquilibriumPropagation()),
        "vertax": (Relaxation(transitions=None, contact_range=None), ImplicitDifferentiation()),
    }
    # (Where the program has run before, in a test, say.)
    runs, seconds = external.ledger.runs, external.ledger.seconds
    fits, metrics = {}, {"n_edges": drawn.n_edges}
    for name, (response, adjoint) in ways.items():
        guess = energy_of(jnp.full_like(true, config.foam.mean))
        problem = InverseProblem(
            target, guess, VertexDistance(target), response=response, adjoint=adjoint
        )
        fit = folder.fit(
            name,
            problem,
            config.fit.build(),
            config.fit.epochs,
            truth=energy_of(true),
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
    columns = {"edge": np.arange(drawn.n_edges), "true": np.asarray(true)}
    columns |= {f"found_{name.split()[-1].lower()}": values for name, values in tensions.items()}
    folder.save_table("edges", columns)
    folder.save_tissue("target", target)
    errors = {name: fit.history.relative_error for name, fit in fits.items()}
    folder.save_figure("recovery", figures.recovery(target, np.asarray(true), tensions, errors))
    return metrics


def _tensions(energy: Any) -> Float[Array, " edges"]:
    """The tensions of an energy of this experiment."""
    return energy.terms[1].tension
