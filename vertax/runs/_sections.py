"""Tables that several configurations share."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Key, Shaped
from pydantic import Field

from vertax import solvers
from vertax.adjoints import (
    AbstractAdjoint,
    AutomaticDifferentiation,
    EquilibriumPropagation,
    ImplicitDifferentiation,
)
from vertax.fitting import stack
from vertax.inference import Microscope
from vertax.initialise import periodic_voronoi
from vertax.io import read_image
from vertax.mesh import Tissue
from vertax.relax import Relaxation
from vertax.runs._config import ConfigError, Section
from vertax.transitions import T1


class RelaxationSection(Section):
    """Relaxation to mechanical equilibrium: the settings of `vertax.Relaxation`."""

    solver: Literal["newton_cg", "lbfgs", "fire", "gradient_descent", "momentum"] = "newton_cg"
    """The minimiser; gradient_descent is the paper's, momentum the same with Nesterov momentum."""
    learning_rate: float = Field(default=1e-2, gt=0)
    """Step of gradient_descent and momentum; the others choose their own."""
    momentum: float = Field(default=0.95, ge=0, lt=1)
    """Fraction of the last step that momentum keeps."""
    transitions: bool = True
    """Whether short edges may flip (T1 transitions)."""
    t1_threshold: float = Field(default=float(T1().threshold), gt=0)
    """Length below which an edge may flip, in units of the root of the mean cell area."""
    max_flips: int = Field(default=int(T1().max_flips), ge=1)
    """Largest number of flips of one edge in a relaxation."""
    tolerance: float | None = Field(default=None, gt=0)
    """Largest force at equilibrium; left out, it depends on the precision."""
    contacts: bool = True
    """Whether contact forces prevent overlaps of cells."""
    contact_range: float = Field(default=float(Relaxation().contact_range or 0), ge=0)
    """Range of contact forces between corner and side, in units of the root of the mean cell area."""
    consecutive_steps: int = Field(default=int(Relaxation().consecutive_steps), ge=1)
    """Number of consecutive steps for which the force must stay below the tolerance."""
    max_steps: int = Field(default=int(Relaxation().max_steps), ge=1)
    """Largest number of steps of the minimiser."""

    def build(self) -> Relaxation:
        """The settings as an object.

        **Returns:** a [`Relaxation`][vertax.Relaxation].
        """
        return Relaxation(
            solver=self._minimiser(),
            transitions=T1(self.t1_threshold, self.max_flips) if self.transitions else None,
            tolerance=self.tolerance,
            contact_range=self.contact_range if self.contacts else None,
            consecutive_steps=self.consecutive_steps,
            max_steps=self.max_steps,
        )

    def _minimiser(self) -> optx.AbstractMinimiser:
        if self.solver == "gradient_descent":
            return solvers.GradientDescent(learning_rate=self.learning_rate)
        if self.solver == "momentum":
            return solvers.Optax(_momentum(self.learning_rate, self.momentum))
        named = {"newton_cg": solvers.NewtonCG, "lbfgs": solvers.LBFGS, "fire": solvers.FIRE}
        return named[self.solver]()


class Fitting(Section):
    """Optimiser of the parameters."""

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


class Gradient(Section):
    """Gradients through the equilibrium."""

    method: Literal["implicit", "sensitivity", "propagation", "unrolled"] = "implicit"
    """Implicit differentiation (adjoint state, or forward sensitivity), equilibrium propagation, or
    differentiation of the steps of the solver, which has to be gradient_descent or momentum."""
    nudge: Literal["linear", "cost"] = "linear"
    """The nudge of equilibrium propagation; cost lets T1 transitions follow the cost."""
    beta: float | None = Field(default=None, gt=0)
    """Its strength; left out, it depends on the precision."""
    nudged_rtol: float | None = Field(default=None, gt=0)
    """Tolerance of nudged relaxations relative to the nudge; left out, it depends on the precision."""
    strict: bool = False
    """Whether a gradient that has not converged ends the fit; the history has its residual."""

    def build(self) -> AbstractAdjoint:
        """The adjoint.

        **Returns:** one of `vertax.adjoints`.
        """
        if self.method == "propagation":
            return EquilibriumPropagation(
                self.beta, self.nudge, rtol=self.nudged_rtol, throw=self.strict
            )
        if self.method == "unrolled":
            return AutomaticDifferentiation(throw=self.strict)
        if self.method == "sensitivity":
            return ImplicitDifferentiation("sensitivity", throw=self.strict)
        return ImplicitDifferentiation(throw=self.strict)


class TissueSection(Section):
    """The tissue, in which the mean area of a cell is 1."""

    n_cells: int = Field(default=20, ge=4)
    """Number of cells."""
    lloyd_steps: int = Field(default=0, ge=0)
    """Steps of Lloyd's algorithm, which make the first tissue more regular."""

    def draw(self, keys: Key[Array, " tissues"]) -> Tissue:
        """Random tissues.

        **Arguments:**

        - `keys`: one key for each tissue.

        **Returns:** the tissues as a batch.
        """
        n, steps = self.n_cells, self.lloyd_steps
        return stack([periodic_voronoi(n, key=key, lloyd_steps=steps) for key in keys])


class ShapeFactors(Section):
    """The normal distribution that shape factors are drawn from."""

    mean: float = Field(default=3.7, gt=0)
    """Mean."""
    deviation: float = Field(default=0.1, ge=0)
    """Standard deviation."""


class ImageFile(Section):
    """An image in a file: the table `image` of a configuration."""

    path: str | None = Field(default=None, min_length=1)
    """The file: TIFF, PNG, …"""
    channel: int | None = Field(default=None, ge=0)
    """Which channel, from 0, if there are several, as in a colour image."""
    plane: int | None = Field(default=None, ge=0)
    """Which plane, from 0, if it is a stack."""

    def read(self) -> Shaped[np.ndarray, "rows columns"]:
        """The image.

        **Returns:** its pixels, in the numbers of the file.

        **Raises:**

        - `ConfigError` if no file is named, or a channel or plane has to be chosen.
        - `FileNotFoundError` and `ValueError` as [`read_image`][vertax.io.read_image].
        """
        if self.path is None:
            raise ConfigError(
                "`image.path` is missing: name an image, as in --set image.path=IMAGE.tif."
            )
        try:
            return read_image(self.path, channel=self.channel, plane=self.plane)
        except ValueError as error:
            for key in ("channel", "plane"):
                if f"`{key}`" in str(error):
                    raise ConfigError(
                        f"{error} It is the key `image.{key}`, as in --set image.{key}=0."
                    ) from error
            raise


class MicroscopeSection(Section):
    """A synthetic microscope; intensities are relative to the brightest membrane."""

    pixels: int = Field(default=128, ge=16)
    """Side of an image in pixels."""
    psf_width: float = Field(default=2.0, ge=1)
    """Standard deviation of the blur in pixels."""
    background: float = Field(default=0.1, ge=0)
    """Intensity where there is no membrane."""
    uneven_gain: float = Field(default=0.0, ge=0, lt=1)
    """Amplitude of a slow variation of brightness over the image."""
    vignetting: float = Field(default=0.0, ge=0, lt=1)
    """How much darker the image is at its corners than in its middle."""
    faint: float = Field(default=0.0, ge=0, le=1)
    """Share of the edges with a faint stretch."""

    def build(self, noise: float) -> Microscope:
        """The microscope.

        **Arguments:**

        - `noise`: standard deviation of the noise of a pixel.

        **Returns:** a [`Microscope`][vertax.inference.Microscope].
        """
        return Microscope(
            noise=noise, **{name: getattr(self, name) for name in MicroscopeSection.model_fields}
        )


# JAX compares Optax optimisers by identity: the same object avoids a second compilation in one process.
@functools.cache
def _momentum(learning_rate: float, momentum: float) -> optax.GradientTransformation:
    return optax.sgd(learning_rate, momentum, nesterov=True)


@functools.cache
def _optimiser(name: str, learning_rate: float) -> optax.GradientTransformation:
    return {"adam": optax.adam, "nadam": optax.nadam}[name](learning_rate)
