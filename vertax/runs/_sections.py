"""Tables that several experiments have in their configuration."""

from __future__ import annotations

import functools
from typing import Any, Literal

import optax
import optimistix as optx
from pydantic import Field

from vertax import solvers
from vertax.runs._config import Section
from vertax.transitions import T1


class Relaxation(Section):
    """How the tissue is relaxed to mechanical equilibrium."""

    solver: Literal["newton_cg", "lbfgs", "fire", "gradient_descent", "momentum"] = "newton_cg"
    """The minimiser; gradient_descent is the paper's, momentum the same with Nesterov momentum."""
    learning_rate: float = Field(default=1e-2, gt=0)
    """Step of gradient_descent and momentum; the others choose their own."""
    momentum: float = Field(default=0.95, ge=0, lt=1)
    """How much of its last step momentum keeps."""
    tolerance: float | None = Field(default=None, gt=0)
    """Largest force that counts as equilibrium; left out, 1e-9 in float64 and 1e-4 in float32."""
    patience: int = Field(default=1, ge=1)
    """Number of consecutive steps for which the force must stay below the tolerance."""
    max_steps: int = Field(default=2000, ge=1)
    """Most steps of the minimiser."""
    transitions: bool = True
    """Whether short edges may flip (T1 transitions)."""
    t1_threshold: float = Field(default=5e-3, gt=0)
    """Length below which an edge may flip, where the mean area of a cell is 1."""
    max_flips: int = Field(default=20, ge=1)
    """How often one edge may flip in a relaxation."""

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `vertax.equilibrate` and `vertax.InverseProblem`.

        **Returns:** solver, transitions, tolerance, patience and max_steps.
        """
        return {
            "solver": self._minimiser(),
            "transitions": T1(self.t1_threshold, self.max_flips) if self.transitions else None,
            "tolerance": self.tolerance,
            "patience": self.patience,
            "max_steps": self.max_steps,
        }

    def _minimiser(self) -> optx.AbstractMinimiser:
        if self.solver == "gradient_descent":
            return solvers.GradientDescent(learning_rate=self.learning_rate)
        if self.solver == "momentum":
            return solvers.Optax(_momentum(self.learning_rate, self.momentum))
        named = {"newton_cg": solvers.NewtonCG, "lbfgs": solvers.LBFGS, "fire": solvers.FIRE}
        return named[self.solver]()


class Fitting(Section):
    """How the parameters are fitted."""

    optimiser: Literal["adam", "nadam"] = "adam"
    """The Optax optimiser; nadam is ADAM with Nesterov momentum, the paper's."""
    learning_rate: float = Field(default=1e-2, gt=0)
    """Step of the optimiser, in units of the parameters."""
    epochs: int = Field(default=200, ge=1)
    """Number of updates of the parameters."""

    def build(self) -> optax.GradientTransformation:
        """The optimiser.

        **Returns:** an Optax optimiser.
        """
        return _optimiser(self.optimiser, self.learning_rate)


# JAX knows an Optax optimiser by identity: a second fit in a process is not compiled again if it gets
# the very same one.
@functools.cache
def _momentum(learning_rate: float, momentum: float) -> optax.GradientTransformation:
    return optax.sgd(learning_rate, momentum, nesterov=True)


@functools.cache
def _optimiser(name: str, learning_rate: float) -> optax.GradientTransformation:
    return {"adam": optax.adam, "nadam": optax.nadam}[name](learning_rate)
