"""Target shape factors of the cells in a microscopy image of an epithelium.

The image is segmented into cells, the cells become a mesh, the mesh a model tissue in mechanical
equilibrium; then target shape factor and rest area of every cell are adjusted until the edges of the
relaxed tissue, blurred as by a microscope, match the image (paper, "Inference of mechanical parameters
from microscopy image"). The image is mirrored to make it periodic, as in the paper, and whole cells of the
original are reported; or the outline of its whole cells is pinned (`model.border`), and those within are.
"""

from __future__ import annotations

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from vertax.costs import MeshImage
from vertax.experiments._imaging import (
    Model,
    Preparation,
    SegmentationSection,
    correlation,
    parameters_of,
    pixel_of,
    read,
)
from vertax.experiments.infer_from_microscopy import figures
from vertax.fitting import Fit, FitError
from vertax.initialise import Segmentation
from vertax.io import read_image
from vertax.mesh import Tissue
from vertax.responses import Equilibrium
from vertax.runs._config import ConfigError, ExperimentConfig
from vertax.runs._folder import RunFolder
from vertax.runs._sections import Fitting, Relaxation
from vertax.runs._tables import fit_metrics, history_columns


class ImageSection(Preparation):
    """The image, and how it is prepared for the comparison with the model."""

    path: str = ""
    """File of a membrane image, bright membranes on dark cells."""
    channel: int | None = None
    """Which channel, if there are several."""
    plane: int | None = None
    """Which plane, if it is a stack."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    experiment: Literal["infer_from_microscopy"] = "infer_from_microscopy"
    """Which experiment this is."""
    image: ImageSection = ImageSection()
    """The image."""
    segmentation: SegmentationSection = SegmentationSection()
    """How the cells are found."""
    model: Model = Model()
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
    if not config.image.path:
        raise ConfigError(
            "`image.path` is missing: name a membrane image, as in --set image.path=IMAGE.tif."
        )
    pixels = read_image(config.image.path, channel=config.image.channel, plane=config.image.plane)
    reading = read(
        np.asarray(pixels, float),
        config.image,
        config.segmentation,
        config.model,
        config.relaxation,
    )
    found, whole, seen, width, first, problem = reading
    folder.save_tissue("target", found.tissue)
    folder.save_tissue("initial", first.tissue)
    folder.save_array("image", seen)
    try:
        outcome = reading.fit(folder, "fit", config.fit, progress=progress)
    except FitError as error:
        if error.fit is not None:
            folder.save_table("history", history_columns(error.fit.history))
            folder.save_tissue("fitted", error.fit.tissue)
        raise
    folder.save_tissue("fitted", outcome.tissue)
    folder.save_table("history", history_columns(outcome.history))
    folder.save_table("cells", _cell_table(found, whole, outcome))
    _draw(found, whole, np.asarray(pixels, float), first.tissue, outcome, folder)
    assert isinstance(problem.cost, MeshImage)
    return _metrics(found, whole, seen, problem.cost, first, outcome, width)


def _membrane_contrast(
    tissue: Tissue, found: Segmentation, seen: Float[np.ndarray, "rows columns"]
) -> float:
    """Mean of the standardised image along the edges, weighted by length."""
    start, vector = (np.asarray(x, float) for x in tissue.edge_segments)
    steps = (np.arange(32) + 0.5) / 32
    points = (start[:, None] + steps[:, None] * vector[:, None]).reshape(-1, 2)
    length = np.repeat(np.linalg.norm(vector, axis=1), 32)
    pixel = pixel_of(found, seen)
    column, row = np.floor(points / pixel).astype(int).T
    inside = (row >= 0) & (row < seen.shape[0]) & (column >= 0) & (column < seen.shape[1])
    values = (seen - seen.mean()) / seen.std()
    return float(np.average(values[row[inside], column[inside]], weights=length[inside]))


def _metrics(
    found: Segmentation,
    whole: Bool[np.ndarray, " cells"],
    seen: Float[np.ndarray, "rows columns"],
    cost: MeshImage,
    first: Equilibrium,
    outcome: Fit,
    width: float,
) -> dict[str, Any]:
    meshes = {"segmented": found.tissue, "initial": first.tissue, "fitted": outcome.tissue}
    factors = parameters_of(outcome.energy)[0][whole]
    metrics: dict[str, Any] = {}
    for name, tissue in meshes.items():
        metrics[f"correlation_{name}"] = correlation(cost, tissue)
        metrics[f"membrane_contrast_{name}"] = _membrane_contrast(tissue, found, seen)
    corners = outcome.tissue.boundary.shortest(outcome.tissue.vertices - found.tissue.vertices)
    return metrics | {
        "n_cells": found.tissue.n_cells,
        "n_whole_cells": int(whole.sum()),
        "shape_factor_mean": factors.mean(),
        "shape_factor_std": factors.std(),
        "shape_factor_median": np.median(factors),
        "observed_shape_factor_mean": np.asarray(outcome.tissue.shape_factors)[whole].mean(),
        "vertex_displacement_from_segmentation": float(jnp.mean(jnp.linalg.norm(corners, axis=-1))),
        "psf_width_pixels": width / found.pixel_size,
        "pixel_size": found.pixel_size,
        **fit_metrics(outcome),
        "num_t1_first_guess": first.num_t1,
    }


def _cell_table(
    found: Segmentation, whole: Bool[np.ndarray, " cells"], outcome: Fit
) -> dict[str, np.ndarray]:
    """One row a whole cell of the original image."""
    tissue = outcome.tissue
    shape_factors, rest_areas = parameters_of(outcome.energy)
    columns = {
        "label": found.labels,
        "target_shape_factor": shape_factors,
        "rest_area": rest_areas,
        "shape_factor": tissue.shape_factors,
        "area": tissue.areas,
        "perimeter": tissue.perimeters,
        "x_pixels": tissue.centroids[:, 0] / found.pixel_size,
        "y_pixels": tissue.centroids[:, 1] / found.pixel_size,
    }
    return {name: np.asarray(column)[whole] for name, column in columns.items()}


def _draw(
    found: Segmentation,
    whole: Bool[np.ndarray, " cells"],
    pixels: Float[np.ndarray, "rows columns"],
    initial: Tissue,
    outcome: Fit,
    folder: RunFolder,
) -> None:
    overlays = {"segmented": found.tissue, "relaxed first guess": initial, "fitted": outcome.tissue}
    folder.save_figure("overlay", figures.overlays(pixels, overlays, pixel_size=found.pixel_size))
    folder.save_figure("convergence", figures.convergence(outcome.history))
    figure = figures.cells_on_image(
        pixels,
        outcome.tissue,
        parameters_of(outcome.energy)[0],
        whole,
        pixel_size=found.pixel_size,
        label="target shape factor $p_0$",
    )
    folder.save_figure("shape_factors", figure)
