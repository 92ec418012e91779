"""From an image to the shape factors of its cells: what experiments on images have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field
from scipy.ndimage import gaussian_filter, zoom

from vertax._equilibrium import Equilibrium, equilibrate
from vertax._fit import Fit, fit
from vertax._inverse import InverseProblem
from vertax._tissue import Tissue
from vertax.costs import MeshImage, mirror
from vertax.energies import ShapeFactorEnergy
from vertax.experiments._config import Section
from vertax.experiments._sections import Fitting, Relaxation
from vertax.initialise import Cellpose, Segmentation, Watershed, from_microscopy


class Preparation(Section):
    """How an image is prepared for the comparison with the model."""

    pixels: int = Field(default=256, ge=32)
    """Longer side, in pixels, of the image that the model is compared with."""
    background_width: float = Field(default=0.5, gt=0)
    """Width of the filter that evens out the illumination, in mean cell diameters."""
    psf_width: float | None = Field(default=None, gt=0)
    """Standard deviation of the blur, in pixels of the file; left out, the one that fits best."""


class SegmentationSection(Section):
    """How the cells are found."""

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


class Model(Section):
    """The energy, E1 with a rest area for each cell, and the first guess."""

    target_shape_factor: float = Field(default=3.7, gt=0)
    """First guess of the target shape factor of every cell."""
    rest_areas: Literal["fitted", "observed", "equal"] = "fitted"
    """Rest areas of the cells: fitted too, beginning with those of the segmented cells; as those are;
    or the mean area in all cells but those that the border cuts, which determines shape factors best
    where it is true."""


class Reading(NamedTuple):
    """An image, and the model tissue before any fit."""

    found: Segmentation
    """The segmented cells."""
    seen: Float[np.ndarray, "rows columns"]
    """The image that the model is compared with."""
    psf_width: float
    """Width of the blur, in units of length."""
    first: Equilibrium
    """The relaxed tissue of the first guess."""
    problem: InverseProblem[ShapeFactorEnergy]
    """The inverse problem, which starts from it."""

    def fit(self, fitting: Fitting, *, progress: bool) -> Fit[ShapeFactorEnergy]:
        """Solve the inverse problem.

        **Arguments:**

        - `fitting`: how.
        - `progress`: show a progress bar (only on a terminal).

        **Returns:** the fit.

        **Raises:**

        - `FitError` if it cannot go on.
        """
        return fit(self.problem, fitting.build(), fitting.epochs, progress=progress)


def read(
    pixels: Float[np.ndarray, "rows columns"],
    preparation: Preparation,
    segmentation: SegmentationSection,
    model: Model,
    relaxation: Relaxation,
    *,
    perturbed: Callable[[Tissue], Tissue] | None = None,
) -> Reading:
    """Segment an image and set up the inverse problem of its shape factors.

    **Arguments:**

    - `pixels`: the image, bright membranes on dark cells.
    - `preparation`, `segmentation`, `model`, `relaxation`: how.
    - `perturbed`: what to do to the segmented mesh before it is relaxed, by default nothing.

    **Returns:** the `Reading`.

    **Raises:**

    - `ValueError` for an image that cannot be used.
    """
    found = from_microscopy(pixels, segmenter=segmentation.build())
    seen = _prepare(np.asarray(pixels, float), found, preparation)
    width = _psf_width(found, seen, preparation)
    cost = MeshImage(mirror(seen), width, points_per_edge=POINTS)
    segmented = found.tissue
    areas = segmented.areas
    if model.rest_areas == "equal":
        # Cells and their mirror images have one label; the mean area is the unit.
        labels, whole = np.asarray(found.labels), np.asarray(found.whole)
        areas = jnp.where(np.isin(labels, labels[whole]), 1.0, areas)
    guess = ShapeFactorEnergy(jnp.full(segmented.n_cells, model.target_shape_factor), areas)
    options = relaxation.options()
    start = segmented if perturbed is None else perturbed(segmented)
    first: Equilibrium = equilibrate(start, guess, **options, throw=False)
    fitted = eqx.tree_at(
        lambda e: (e.target_shape_factor, e.mean_area), guess, (True, model.rest_areas == "fitted")
    )
    # The mirror planes hold the tissue in its place: there is no position to fit.
    problem = InverseProblem(first.tissue, guess, cost, fitted, **options)
    return Reading(found, seen, width, first, problem)


POINTS = 48
"""Quadrature points on each edge."""


def _prepare(
    pixels: Float[np.ndarray, "rows columns"], found: Segmentation, options: Preparation
) -> Float[np.ndarray, "coarse_rows coarse_columns"]:
    """The image in even light, and no finer than it need be."""
    # The logarithm brings bright junctions and faint membranes together, as the segmentation does.
    bright = pixels - pixels.min()
    bright = np.log1p(bright / bright.mean())
    diameter = 1 / found.pixel_size  # the mean cell area is 1
    even = bright - gaussian_filter(bright, options.background_width * diameter, mode="reflect")
    factor = options.pixels / max(pixels.shape)
    if factor >= 1:
        return even
    shape = [max(16, round(side * factor)) for side in pixels.shape]
    smooth = gaussian_filter(even, 0.35 / factor, mode="reflect")
    steps = [new / old for new, old in zip(shape, pixels.shape, strict=True)]
    # Pixels as areas: the coarse image covers the same extent as the fine one.
    return np.asarray(zoom(smooth, steps, order=1, mode="reflect", grid_mode=True))


def _psf_width(
    found: Segmentation, seen: Float[np.ndarray, "rows columns"], options: Preparation
) -> float:
    """Width of the blur in units of length: as configured, or as fits the segmented mesh best."""
    if options.psf_width is not None:
        return options.psf_width * found.pixel_size
    image = mirror(seen)
    pixel = found.pixel_size * found.image_shape[1] / seen.shape[1]

    @eqx.filter_jit
    def misfit(width: Float[Array, ""]) -> Float[Array, ""]:
        return MeshImage(image, width, points_per_edge=POINTS)(found.tissue, NO_ENERGY)

    widths = pixel * np.geomspace(1.0, 12.0, 30)
    return float(widths[np.argmin([float(misfit(jnp.asarray(w))) for w in widths])])


NO_ENERGY = ShapeFactorEnergy(0.0)  # the image cost does not look at the energy


def correlation(cost: MeshImage, tissue: Tissue) -> float:
    r"""Correlation of the blurred mesh with the image.

    **Arguments:**

    - `cost`: the cost of the image.
    - `tissue`: the mesh.

    **Returns:** $\rho$; the cost is half of $1 - \rho^2$.
    """
    value = eqx.filter_jit(lambda t: cost(t, NO_ENERGY))(tissue)
    return float(np.sqrt(max(0.0, 1 - 2 * float(value))))
