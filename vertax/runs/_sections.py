"""Tables that several configurations share."""

from __future__ import annotations

import functools
from typing import Literal

import jax
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Float, Key, PRNGKeyArray, Shaped
from pydantic import Field, field_validator, model_validator

from vertax import solvers
from vertax.adjoints import (
    AbstractAdjoint,
    AutomaticDifferentiation,
    EquilibriumPropagation,
    ImplicitDifferentiation,
)
from vertax.energies import LocalSum
from vertax.fitting import stack
from vertax.inference import (
    Micrograph,
    Microscope as SyntheticMicroscope,
    foam_energy,
    micrograph_problem,
)
from vertax.initialise import Cellpose, Watershed, periodic_voronoi
from vertax.io import read_image
from vertax.mesh import Tissue
from vertax.relax import Relaxation as Response
from vertax.runs._config import Section
from vertax.runs._errors import ConfigError
from vertax.transitions import T1


class Relaxation(Section):
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
    contact_range: float = Field(default=float(Response().contact_range or 0), ge=0)
    """Range of contact forces between corner and side, in units of the root of the mean cell area."""
    consecutive_steps: int = Field(default=int(Response().consecutive_steps), ge=1)
    """Number of consecutive steps for which the force must stay below the tolerance."""
    max_steps: int = Field(default=int(Response().max_steps), ge=1)
    """Largest number of steps of the minimiser."""

    def build(self) -> Response:
        """The settings as an object.

        **Returns:** a [`Relaxation`][vertax.Relaxation].
        """
        return Response(
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


class TensionRange(Section):
    """Line tensions of the edges and stiffness of the cells, where the mean rest area of a cell is 1."""

    low: float = Field(default=0.04, ge=0)
    """Smallest tension."""
    high: float = Field(default=0.28, gt=0)
    """Largest tension; above twice the smallest one, some junctions of three edges have no balance and become
    four-fold vertices."""
    stiffness: float = Field(default=1.0, gt=0)
    """Stiffness of the areas of cells."""

    @model_validator(mode="after")
    def _ordered(self) -> TensionRange:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, but they are {self.low} and {self.high}")
        return self

    def draw(self, tissue: Tissue, spread: float, key: PRNGKeyArray) -> LocalSum:
        """The energy E2 with a tension for each edge.

        **Arguments:**

        - `tissue`: the tissue.
        - `spread`: the share of the range, about its middle, that tensions are drawn from; below 1.
        - `key`: of the draw.

        **Returns:** the energy, see [`foam_energy`][vertax.inference.foam_energy].
        """
        unit = jax.random.uniform(key, (tissue.n_edges,), minval=-1.0, maxval=1.0)
        tension = self.low + (self.high - self.low) * (0.5 + 0.5 * spread * unit)
        return foam_energy(tension, stiffness=self.stiffness, low=self.low, high=self.high)


class ImageFile(Section):
    """An image in a file: the table `image` of a configuration."""

    path: str | None = None
    """The file: TIFF, PNG, …"""
    channel: int | None = Field(default=None, ge=0)
    """Which channel, from 0, if there are several, as in a colour image."""
    plane: int | None = Field(default=None, ge=0)
    """Which plane, from 0, if it is a stack."""

    @field_validator("path")
    @classmethod
    def _not_empty(cls, path: str | None) -> str | None:
        return path if path is None else file_name(path)

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


class Preparation(Section):
    """How an image is prepared for the comparison with the model."""

    pixels: int = Field(default=256, ge=32)
    """Longer side, in pixels, of the image that the model is compared with."""
    background_width: float = Field(default=0.5, gt=0)
    """Width of the filter that evens out the illumination, in mean cell diameters."""
    psf_width: float | None = Field(default=None, gt=0)
    """Standard deviation of the blur, in pixels of the file; left out, the one that fits best."""


class Segmenter(Section):
    """Segmentation of the cells."""

    method: Literal["watershed", "cellpose"] = "watershed"
    """Cellpose needs its own extra and downloads a model."""
    cell_size: float | None = Field(default=None, gt=0)
    """Typical diameter of a cell in pixels of the file; left out, estimated from the image."""

    def build(self) -> Watershed | Cellpose:
        """The segmenter.

        **Returns:** a [`Watershed`][vertax.initialise.Watershed] or
        [`Cellpose`][vertax.initialise.Cellpose].
        """
        if self.method == "cellpose":
            return Cellpose(diameter=self.cell_size)
        return Watershed(cell_size=self.cell_size)


class MicrographModel(Section):
    """The energy, E1 with a rest area for each cell, and the first guess."""

    target_shape_factor: float = Field(default=3.7, gt=0)
    """First guess of the target shape factor of every cell."""
    border: Literal["mirrored", "pinned"] = "mirrored"
    """What holds the tissue at the border of the image: the image is mirrored, cells that the border cuts
    included (as in the paper); or the outline of its complete cells is pinned."""
    pixel_size: float | None = Field(default=None, gt=0)
    """Length of a pixel of the file, where rest areas are 1 (of a pinned border only); left out, the mean
    area of the complete cells is 1. In a rigid tissue all shape factors depend on it."""
    rest_areas: Literal["fitted", "observed", "equal"] = "fitted"
    """Rest areas of the cells: fitted too, beginning with those of the segmented cells; as those are;
    or the mean area in all cells but those that the border cuts, which determines shape factors best
    where it is true. A pinned border always has equal ones."""


class Microscope(Section):
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

    def build(self, noise: float) -> SyntheticMicroscope:
        """The microscope.

        **Arguments:**

        - `noise`: standard deviation of the noise of a pixel.

        **Returns:** a [`Microscope`][vertax.inference.Microscope].
        """
        return SyntheticMicroscope(
            noise=noise, **{name: getattr(self, name) for name in Microscope.model_fields}
        )


def file_name(path: str) -> str:
    """Check a key that names a file; an empty one usually comes from a shell variable that is not set.

    **Arguments:**

    - `path`: the value of the key.

    **Returns:** the same.

    **Raises:**

    - `ValueError` if it is empty.
    """
    if not path.strip():
        raise ValueError("must name a file, but is empty")
    return path


def read_micrograph(
    image: Shaped[np.ndarray, "rows columns"],
    preparation: Preparation,
    segmenter: Segmenter,
    model: MicrographModel,
    relaxation: Relaxation,
) -> Micrograph:
    """Segment an image and set up the inverse problem of its shape factors.

    **Arguments:**

    - `image`: the image, bright membranes on dark cells.
    - `preparation`, `segmenter`, `model`, `relaxation`: the settings.

    **Returns:** the [`Micrograph`][vertax.inference.Micrograph].

    **Raises:** as [`micrograph_problem`][vertax.inference.micrograph_problem].
    """
    return micrograph_problem(
        np.asarray(image, float),
        segmenter=segmenter.build(),
        response=relaxation.build(),
        **{name: getattr(preparation, name) for name in Preparation.model_fields},
        **model.model_dump(),
    )


def replicate_keys(seed: int, n: int) -> list[PRNGKeyArray]:
    """Random keys of replicates; each is independent of the number of replicates.

    **Arguments:**

    - `seed`: the seed of the run.
    - `n`: number of replicates.

    **Returns:** the keys.
    """
    return [jax.random.fold_in(jax.random.key(seed), k) for k in range(n)]


def spread_of(values: Float[np.ndarray, " *values"]) -> dict[str, float]:
    """Mean and standard deviation, for metrics.

    **Arguments:**

    - `values`: numbers.

    **Returns:** both by name.
    """
    values = np.asarray(values, float)
    return {"mean": float(values.mean()), "deviation": float(values.std())}


# JAX compares Optax optimisers by identity: the same object avoids a second compilation in one process.
@functools.cache
def _momentum(learning_rate: float, momentum: float) -> optax.GradientTransformation:
    return optax.sgd(learning_rate, momentum, nesterov=True)


@functools.cache
def _optimiser(name: str, learning_rate: float) -> optax.GradientTransformation:
    return {"adam": optax.adam, "nadam": optax.nadam}[name](learning_rate)
