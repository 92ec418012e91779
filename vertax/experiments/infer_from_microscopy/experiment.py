"""Target shape factors of the cells in a microscopy image of an epithelium.

The image is segmented into cells, the cells become a mesh, the mesh a model tissue in mechanical
equilibrium; then target shape factor and rest area of every cell are adjusted until the edges of the
relaxed tissue, blurred as by a microscope, match the image (paper, "Inference of mechanical parameters
from microscopy image"). The image is mirrored to make it periodic, as in the paper, and whole cells of the
original are reported; or the outline of its whole cells is pinned (`model.border`), and those within are.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax._base.pixels import pixel_length, pixel_sides
from vertax.fitting import Fit
from vertax.inference import Micrograph
from vertax.plotting import plot_history
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    ImageFile,
    MicrographModel,
    Preparation,
    Relaxation,
    RunFolder,
    Segmenter,
    fit_metrics,
    history_columns,
    read_micrograph,
)

from . import figures


class ImageSection(Preparation, ImageFile):
    """The image, bright membranes on dark cells, and how it is prepared for the comparison."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    image: ImageSection = ImageSection()
    """The image."""
    segmentation: Segmenter = Segmenter()
    """How the cells are found."""
    model: MicrographModel = MicrographModel()
    """The energy and the first guess."""
    fit: Fitting = Fitting(learning_rate=2e-2, epochs=150)
    """How the parameters are fitted."""
    relaxation: Relaxation = Relaxation(tolerance=1e-7)
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics. `correlation_*` compare the blurred mesh with the image, for the
    segmented mesh (straight edges between its corners), the relaxed tissue of the first guess and the
    fitted one; `membrane_contrast_*` is how much brighter the image is along the edges than
    elsewhere, in standard deviations of the image, in the original image alone.

    **Raises:**

    - `ConfigError` if no image is named; `FileNotFoundError` and `ValueError` for one that cannot be
        used; `FitError` if the fit cannot go on.
    """
    pixels = np.asarray(config.image.read(), float)
    micrograph = read_micrograph(
        pixels, config.image, config.segmentation, config.model, config.relaxation
    )
    folder.save_tissue("target", micrograph.segmentation.tissue)
    folder.save_tissue("initial", micrograph.first.tissue)
    folder.save_array("image", micrograph.image)
    optimiser, epochs = config.fit.build(), config.fit.epochs
    outcome = folder.fit("fit", micrograph.problem, optimiser, epochs, progress=progress)
    folder.save_tissue("fitted", outcome.tissue)
    folder.save_table("history", history_columns(outcome.history))
    folder.save_table("cells", _cell_table(micrograph, outcome))
    _draw(micrograph, pixels, outcome, folder)
    metrics = _metrics(micrograph, outcome)
    if metrics["correlation_fitted"] < 0.5:
        folder.warn(
            "the fitted mesh explains less than a quarter of the variance of the image (correlation "
            f"{metrics['correlation_fitted']:.2f}): look at figures/overlay, and at the segmentation"
        )
    return metrics


def _metrics(micrograph: Micrograph, outcome: Fit) -> dict[str, Any]:
    found, first = micrograph.segmentation, micrograph.first
    meshes = {"segmented": found.tissue, "initial": first.tissue, "fitted": outcome.tissue}
    factors = micrograph.parameters(outcome.energy)[0][micrograph.whole]
    metrics: dict[str, Any] = {}
    for name, tissue in meshes.items():
        metrics[f"correlation_{name}"] = micrograph.correlation(tissue)
        metrics[f"membrane_contrast_{name}"] = micrograph.membrane_contrast(tissue)
    corners = outcome.tissue.boundary.shortest(outcome.tissue.vertices - found.tissue.vertices)
    observed = np.asarray(outcome.tissue.shape_factors)[micrograph.whole]
    return metrics | {
        "n_cells": found.tissue.n_cells,
        "n_whole_cells": int(micrograph.whole.sum()),
        "shape_factor_mean": factors.mean(),
        "shape_factor_std": factors.std(),
        "shape_factor_median": np.median(factors),
        "observed_shape_factor_mean": observed.mean(),
        "vertex_displacement_from_segmentation": float(jnp.mean(jnp.linalg.norm(corners, axis=-1))),
        "psf_width_pixels": micrograph.psf_width / pixel_length(found.pixel_size),
        "pixel_size": found.pixel_size,
        **fit_metrics(outcome),
        "num_t1_first_guess": first.num_t1,
    }


def _cell_table(micrograph: Micrograph, outcome: Fit) -> dict[str, np.ndarray]:
    """One row a whole cell of the original image."""
    tissue, found = outcome.tissue, micrograph.segmentation
    shape_factors, rest_areas = micrograph.parameters(outcome.energy)
    columns = {
        "label": found.labels,
        "target_shape_factor": shape_factors,
        "rest_area": rest_areas,
        "shape_factor": tissue.shape_factors,
        "area": tissue.areas,
        "perimeter": tissue.perimeters,
        "x_pixels": tissue.centroids[:, 0] / pixel_sides(found.pixel_size)[0],
        "y_pixels": tissue.centroids[:, 1] / pixel_sides(found.pixel_size)[1],
    }
    return {name: np.asarray(column)[micrograph.whole] for name, column in columns.items()}


def _draw(
    micrograph: Micrograph,
    pixels: Float[np.ndarray, "rows columns"],
    outcome: Fit,
    folder: RunFolder,
) -> None:
    found, initial = micrograph.segmentation, micrograph.first.tissue
    overlays = {"segmented": found.tissue, "relaxed first guess": initial, "fitted": outcome.tissue}
    folder.save_figure(
        "overlay", figures.overlays(pixels, overlays, pixel_size=pixel_length(found.pixel_size))
    )
    convergence = Figure()
    plot_history(outcome.history, figure=convergence)
    folder.save_figure("convergence", convergence)
    figure = figures.cells_on_image(
        pixels,
        outcome.tissue,
        micrograph.parameters(outcome.energy)[0],
        micrograph.whole,
        pixel_size=pixel_length(found.pixel_size),
        label="target shape factor $p_0$",
    )
    folder.save_figure("shape_factors", figure)
