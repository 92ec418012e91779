"""From an image to the shape factors of its cells: what experiments on images have in common."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from pydantic import Field
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter, zoom

from vertax.costs import MeshImage, mirror
from vertax.energies import AbstractEnergy, ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem
from vertax.initialise import Cellpose, Segmentation, Watershed, from_labels, from_microscopy
from vertax.mesh import Tissue
from vertax.responses import Equilibrium, equilibrate
from vertax.runs._config import Section
from vertax.runs._folder import RunFolder
from vertax.runs._sections import Fitting, Relaxation


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
    border: Literal["mirrored", "pinned"] = "mirrored"
    """What holds the tissue at the border of the image: the image is mirrored, cells that the border cuts
    included (as in the paper); or the outline of the cells that lie whole in it is pinned."""
    pixel_size: float | None = Field(default=None, gt=0)
    """Length of a pixel of the file, where rest areas are 1 (of a pinned border only); left out, the mean
    area of the cells that are seen whole is 1. In a rigid tissue all shape factors depend on it."""
    rest_areas: Literal["fitted", "observed", "equal"] = "fitted"
    """Rest areas of the cells: fitted too, beginning with those of the segmented cells; as those are;
    or the mean area in all cells but those that the border cuts, which determines shape factors best
    where it is true. A pinned border goes with equal ones, whatever is said here."""


class Reading(NamedTuple):
    """An image, and the model tissue before any fit."""

    found: Segmentation
    """The segmented cells."""
    whole: Bool[np.ndarray, " cells"]
    """Which of them are reported: no part of them, nor of what they touch, is out of sight."""
    seen: Float[np.ndarray, "rows columns"]
    """The image that the model is compared with."""
    psf_width: float
    """Width of the blur, in units of length."""
    first: Equilibrium
    """The relaxed tissue of the first guess."""
    problem: InverseProblem[Any]
    """The inverse problem, which starts from it."""

    def fit(self, folder: RunFolder, name: str, fitting: Fitting, *, progress: bool) -> Fit[Any]:
        """Solve the inverse problem.

        **Arguments:**

        - `folder`, `name`: see `RunFolder.fit`.
        - `fitting`: how.
        - `progress`: show a progress bar (only on a terminal).

        **Returns:** the fit.

        **Raises:**

        - `FitError` if it cannot go on.
        """
        return folder.fit(name, self.problem, fitting.build(), fitting.epochs, progress=progress)


def read(
    pixels: Float[np.ndarray, "rows columns"],
    preparation: Preparation,
    segmentation: SegmentationSection,
    model: Model,
    relaxation: Relaxation,
) -> Reading:
    """Segment an image and set up the inverse problem of its shape factors.

    **Arguments:**

    - `pixels`: the image, bright membranes on dark cells.
    - `preparation`, `segmentation`, `model`, `relaxation`: how.

    **Returns:** the `Reading`.

    **Raises:**

    - `ValueError` for an image that cannot be used.
    """
    if model.border == "pinned":
        return _read_pinned(pixels, preparation, segmentation, model, relaxation)
    found = from_microscopy(pixels, segmenter=segmentation.build())
    seen = _prepare(np.asarray(pixels, float), found, preparation)
    image = {"image": mirror(seen), "points_per_edge": POINTS}
    width = _psf_width(found, seen, preparation, image)
    segmented = found.tissue
    areas = segmented.areas
    if model.rest_areas == "equal":
        # Cells and their mirror images have one label; the mean area is the unit.
        labels, whole = np.asarray(found.labels), np.asarray(found.whole)
        areas = jnp.where(np.isin(labels, labels[whole]), 1.0, areas)
    guess = ShapeFactorEnergy(jnp.full(segmented.n_cells, model.target_shape_factor), areas)
    options = relaxation.options()
    first: Equilibrium = equilibrate(segmented, guess, **options, throw=False)
    fitted = eqx.tree_at(
        lambda e: (e.target_shape_factor, e.mean_area), guess, (True, model.rest_areas == "fitted")
    )
    # The mirror planes hold the tissue in its place: there is no position to fit.
    problem = InverseProblem(
        first.tissue, guess, MeshImage(psf_width=width, **image), fitted, **options
    )
    return Reading(found, np.asarray(found.whole), seen, width, first, problem)


class BorderedEnergy(AbstractEnergy):
    """E1 of cells of rest area 1, but for those at the border of what is seen.

    What a cell at the border feels from beyond it is not known, so its rest area is free.
    """

    target_shape_factor: Float[Array, " cells"]
    log_border_area: Float[Array, " cells"]
    inner: Bool[np.ndarray, " cells"]

    @property
    def mean_area(self) -> Float[Array, " cells"]:
        """Rest areas."""
        return jnp.where(self.inner, 1.0, jnp.exp(self.log_border_area))

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy."""
        return ShapeFactorEnergy(self.target_shape_factor, self.mean_area)(tissue)


def parameters_of(
    energy: AbstractEnergy,
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """What was fitted to an image.

    **Arguments:**

    - `energy`: of a fit of a `Reading`.

    **Returns:** target shape factor and rest area of each cell.
    """
    assert isinstance(energy, ShapeFactorEnergy | BorderedEnergy)
    return np.asarray(energy.target_shape_factor, float), np.asarray(energy.mean_area, float)


def _read_pinned(
    pixels: Float[np.ndarray, "rows columns"],
    preparation: Preparation,
    segmentation: SegmentationSection,
    model: Model,
    relaxation: Relaxation,
) -> Reading:
    """The cells that lie whole in the image, as a free tissue whose outline does not move."""
    labels = np.asarray(segmentation.build()(pixels))
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    labels = np.where(np.isin(labels, rim), 0, labels)
    found = from_labels(labels, boundary="free", pixel_size=model.pixel_size)
    cluster = found.tissue
    on_outline = np.asarray(cluster.topology.on_outline)
    outline = np.asarray(cluster.topology.edge_cells)[on_outline]
    inner = ~np.isin(np.arange(cluster.n_cells), outline)
    ends = np.asarray(cluster.topology.edge_vertices)[on_outline]
    pinned = np.isin(np.arange(cluster.n_vertices), ends)
    segmented = Tissue(
        cluster.vertices, cluster.topology, cluster.boundary, cluster.softening, pinned=pinned
    )
    seen = _prepare(np.asarray(pixels, float), found, preparation)
    pixel = pixel_of(found, seen)
    weight = _away_from(segmented, on_outline, labels > 0, pixel, seen.shape)
    image = {"image": seen, "points_per_edge": POINTS, "weight": weight, "pixel_size": pixel}
    width = _psf_width(found, seen, preparation, image)
    # Straight edges cut off the corners of cells on the outline, of some nearly all of the cell.
    areas = jnp.log(jnp.maximum(segmented.areas, 0.2))
    guess = BorderedEnergy(jnp.full(cluster.n_cells, model.target_shape_factor), areas, inner)
    options = relaxation.options()
    first: Equilibrium = equilibrate(segmented, guess, **options, throw=False)
    problem = InverseProblem(first.tissue, guess, MeshImage(psf_width=width, **image), **options)
    return Reading(found, inner, seen, width, first, problem)


def _away_from(
    tissue: Tissue,
    on_outline: Bool[np.ndarray, " edges"],
    cells: Bool[np.ndarray, "rows columns"],
    pixel: float,
    shape: tuple[int, int],
) -> Float[np.ndarray, "coarse_rows coarse_columns"]:
    """1 where pixels count: inside of the outline, in the image and in the mesh, and not close to it."""
    # The outline is no interface of two cells, and the mesh cuts its corners: it is not compared.
    inside = binary_closing(np.pad(cells, 8), iterations=6)[8:-8, 8:-8]
    margin = 0.15 / pixel * cells.shape[1] / shape[1]
    inside = distance_transform_edt(inside) > margin
    steps = [new / old for new, old in zip(shape, cells.shape, strict=True)]
    near = np.asarray(zoom(inside.astype(float), steps, order=1, grid_mode=True, mode="nearest"))
    start, vector = (np.asarray(x, float)[on_outline, None] for x in tissue.edge_segments)
    points = ((np.indices(shape)[::-1] + 0.5) * pixel).reshape(2, -1).T
    along = np.sum((points - start) * vector, axis=-1) / np.sum(vector**2, axis=-1)
    foot = start + np.clip(along, 0, 1)[..., None] * vector
    distance = np.linalg.norm(points - foot, axis=-1).min(axis=0).reshape(shape)
    return np.where(distance > 0.15, np.clip(near, 0, 1), 0.0)


def pixel_of(found: Segmentation, seen: Float[np.ndarray, "rows columns"]) -> float:
    """Length of a pixel side of the prepared image, which may be coarser than the file.

    **Arguments:**

    - `found`: the segmented cells.
    - `seen`: the prepared image.

    **Returns:** the length, in units of the tissue.
    """
    return found.pixel_size * found.image_shape[1] / seen.shape[1]


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
    found: Segmentation,
    seen: Float[np.ndarray, "rows columns"],
    options: Preparation,
    image: dict[str, Any],
) -> float:
    """Width of the blur in units of length: as configured, or as fits the segmented mesh best."""
    if options.psf_width is not None:
        return options.psf_width * found.pixel_size

    @eqx.filter_jit
    def misfit(width: Float[Array, ""]) -> Float[Array, ""]:
        return MeshImage(psf_width=width, **image)(found.tissue, NO_ENERGY)

    widths = pixel_of(found, seen) * np.geomspace(1.0, 12.0, 30)
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
