"""Infer the target shape factors of the cells in a microscopy image.

The image is segmented, the cells become a mesh, and the mesh a model tissue at equilibrium. Target shape
factor and rest area of each cell are then fitted until the edges of the relaxed tissue, blurred as by a
microscope, match the image (paper, "Inference of mechanical parameters from microscopy image"). The image is
mirrored to make it periodic, as in the paper, and the complete cells of the original are reported; or the
outline of its complete cells is pinned (`model.border`), and the cells inside are reported.
"""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped
from matplotlib.figure import Figure
from pydantic import Field

from vertax import runs
from vertax.fitting import Fit
from vertax.inference import Micrograph, micrograph_problem
from vertax.initialise import Cellpose, Watershed
from vertax.io import pixel_sides
from vertax.mesh import Tissue
from vertax.plotting import plot_history, plot_tissue, plot_tissues, scale_bar


class Preparation(runs.Section):
    """How an image is prepared for the comparison with the model."""

    pixels: int = Field(default=256, ge=32)
    """Longer side, in pixels, of the image that the model is compared with."""
    background_width: float = Field(default=0.5, gt=0)
    """Width of the filter that evens out the illumination, in mean cell diameters."""
    psf_width: float | None = Field(default=None, gt=0)
    """Standard deviation of the blur, in pixels of the file; left out, the one that fits best."""


class Segmenter(runs.Section):
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


class MicrographModel(runs.Section):
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


def read_micrograph(
    image: Shaped[np.ndarray, "rows columns"],
    preparation: Preparation,
    segmenter: Segmenter,
    model: MicrographModel,
    relaxation: runs.RelaxationSection,
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


class ImageSection(Preparation, runs.ImageFile):
    """The image, bright membranes on dark cells, and its preparation for the comparison."""


class Config(runs.ExperimentConfig):
    """Configuration of this job."""

    image: ImageSection = ImageSection()
    """The image."""
    segmentation: Segmenter = Segmenter()
    """Segmentation of the cells."""
    model: MicrographModel = MicrographModel()
    """The energy and the first guess."""
    fit: runs.Fitting = runs.Fitting(learning_rate=2e-2, epochs=150)
    """Fit of the parameters."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(tolerance=1e-7)
    """Relaxation of the tissue."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Fit the parameters of a micrograph.

    **Returns:** the metrics. `correlation_*` compare the blurred mesh with the image, for the segmented mesh
    (straight edges between its corners), the relaxed tissue of the first guess and the fitted one;
    `membrane_contrast_*` is the difference of the brightness along the edges and elsewhere, in standard
    deviations of the original image.

    **Raises:**

    - `ConfigError` if no image is named; `FileNotFoundError` and `ValueError` for an unusable one; `FitError`
        if the fit fails.
    """
    pixels = np.asarray(config.image.read(), float)
    settings = config.image, config.segmentation, config.model, config.relaxation
    micrograph = read_micrograph(pixels, *settings)
    folder.save_tissue("target", micrograph.segmentation.tissue)
    folder.save_tissue("initial", micrograph.first.tissue)
    folder.save_array("image", micrograph.image)
    optimiser, epochs = config.fit.build(), config.fit.epochs
    fit = folder.fit("fit", micrograph.problem, optimiser, epochs, progress=progress)
    folder.save_tissue("fitted", fit.tissue)
    folder.save_table("history", runs.history_table(fit.history))
    folder.save_table("cells", cell_table(micrograph, fit))
    draw(micrograph, pixels, fit, folder)
    metrics = measure(micrograph, fit)
    if metrics["correlation_fitted"] < 0.5:
        folder.warn(
            "the fitted mesh explains less than a quarter of the variance of the image (correlation "
            f"{metrics['correlation_fitted']:.2f}): look at figures/overlay, and at the segmentation"
        )
    return metrics


def measure(micrograph: Micrograph, fit: Fit) -> dict[str, Any]:
    """The metrics."""
    segmentation, first, complete = micrograph.segmentation, micrograph.first, micrograph.complete
    meshes = {"segmented": segmentation.tissue, "initial": first.tissue, "fitted": fit.tissue}
    factors = micrograph.parameters(fit.energy)[0][complete]
    metrics: dict[str, Any] = {}
    for name, tissue in meshes.items():
        metrics[f"correlation_{name}"] = micrograph.correlation(tissue)
        metrics[f"membrane_contrast_{name}"] = micrograph.membrane_contrast(tissue)
    displacements = fit.tissue.boundary.shortest(fit.tissue.vertices - segmentation.tissue.vertices)
    distance = float(jnp.mean(jnp.linalg.norm(displacements, axis=-1)))
    return metrics | {
        "n_cells": segmentation.tissue.n_cells,
        "n_whole_cells": int(complete.sum()),
        "shape_factor_mean": factors.mean(),
        "shape_factor_std": factors.std(),
        "shape_factor_median": np.median(factors),
        "observed_shape_factor_mean": np.asarray(fit.tissue.shape_factors)[complete].mean(),
        "vertex_displacement_from_segmentation": distance,
        "psf_width_pixels": micrograph.psf_width
        / np.sqrt(np.prod(pixel_sides(segmentation.pixel_size))),
        "pixel_size": segmentation.pixel_size,
        **runs.fit_metrics(fit),
        "num_t1_first_guess": first.num_t1,
    }


def cell_table(micrograph: Micrograph, fit: Fit) -> dict[str, np.ndarray]:
    """One row per complete cell of the original image."""
    tissue, segmentation = fit.tissue, micrograph.segmentation
    shape_factors, rest_areas = micrograph.parameters(fit.energy)
    sides = pixel_sides(segmentation.pixel_size)
    columns = {
        "label": segmentation.labels,
        "target_shape_factor": shape_factors,
        "rest_area": rest_areas,
        "shape_factor": tissue.shape_factors,
        "area": tissue.areas,
        "perimeter": tissue.perimeters,
        "x_pixels": tissue.centroids[:, 0] / sides[0],
        "y_pixels": tissue.centroids[:, 1] / sides[1],
    }
    return {name: np.asarray(column)[micrograph.complete] for name, column in columns.items()}


def draw(micrograph: Micrograph, pixels: np.ndarray, fit: Fit, folder: runs.RunFolder) -> None:
    """Write the figures."""
    segmentation, initial = micrograph.segmentation, micrograph.first.tissue
    size = segmentation.pixel_size
    meshes = {"segmented": segmentation.tissue, "relaxed first guess": initial}
    overlays = plot_overlays(pixels, meshes | {"fitted": fit.tissue}, pixel_size=size)
    folder.save_figure("overlay", overlays)
    plot_history(fit.history, figure=(convergence := Figure()))
    folder.save_figure("convergence", convergence)
    values, complete = micrograph.parameters(fit.energy)[0], micrograph.complete
    folder.save_figure("shape_factors", plot_cells(pixels, fit.tissue, values, complete, size))


def plot_overlays(image: np.ndarray, panels: dict[str, Tissue], *, pixel_size: Any) -> Figure:
    """Meshes over the image; its first row and column begin at y = 0 and x = 0."""
    figure = Figure()
    axes = plot_tissues(panels, figure=figure, image=image, pixel_size=pixel_size, linewidth=0.9)
    scale_bar(axes[0], "pixels", unit_length=pixel_sides(pixel_size)[0])
    return figure


def plot_cells(
    image: np.ndarray, tissue: Tissue, values: Any, mask: Any, pixel_size: Any
) -> Figure:
    """The cells of a mask over the image, coloured by their target shape factors."""
    figure = Figure()
    options: Any = {"mask": mask, "label": "target shape factor $p_0$", "pixel_size": pixel_size}
    ax = plot_tissue(tissue, values, figure=figure, image=image, **options)
    scale_bar(ax, "pixels", unit_length=pixel_sides(pixel_size)[0])
    return figure
