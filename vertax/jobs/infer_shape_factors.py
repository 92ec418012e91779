"""Recover the target shape factors of a synthetic tissue from its vertices or an image.

A periodic Voronoi tissue gets a random target shape factor for each cell and is relaxed. The fit has its
topology and its vertices or a microscopy image of it; it starts from a guess and recovers the shape factors
(paper, "Benchmarking bilevel optimization approaches on vertex models").
"""

from typing import Any, Literal

import jax
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from vertax import inference, runs
from vertax.costs import AbstractCost, MeshImage, VertexDistance
from vertax.fitting import Fit, InverseProblem
from vertax.plotting import plot_history, plot_recovery, plot_tissues, scale_bar

NAME = "$p_0$"


class ImageSection(runs.MicroscopeSection):
    """The synthetic microscopy image; intensities are relative to the brightest membrane."""

    noise: float = Field(default=0.05, ge=0)
    """Standard deviation of the noise of a pixel."""


class Config(runs.ExperimentConfig):
    """Configuration of this job."""

    data: Literal["vertices", "image", "both"] = "vertices"
    """Data of the fit; both makes one fit from each."""
    guess: Literal["redrawn", "mean"] = "redrawn"
    """First guess: another draw of the distribution, or its mean in all cells."""
    tissue: runs.TissueSection = runs.TissueSection()
    """The tissue."""
    truth: runs.ShapeFactors = runs.ShapeFactors()
    """Distribution of the true shape factors."""
    image: ImageSection = ImageSection()
    """The synthetic microscopy image."""
    fit: runs.Fitting = runs.Fitting()
    """Fit of the parameters."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection()
    """Relaxation of the tissue."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Draw a tissue and fit its shape factors.

    **Returns:** the metrics: `pearson`, `relative_error`, `cost_initial`, `cost_final`, `max_force` and
    others of the fit; with both kinds of data, those of the vertices and a mapping for each.

    **Raises:**

    - `FitError` if a fit fails.
    """
    both = config.data == "both"
    scene, image = make_scene(config)
    folder.save_tissue("target", scene.target)
    folder.save_tissue("initial", scene.initial)
    figure = plot_panels({"target": (scene.target, scene.truth)}, label=f"true {NAME}")
    folder.save_figure("target", figure)
    if image is not None:
        folder.save_array("image", image)
    metrics: dict[str, dict[str, Any]] = {}
    fits: dict[str, Fit] = {}
    for source in ("vertices", "image") if both else (config.data,):
        fits[source] = fit = fit_scene(config, scene, image, source, folder, progress)
        save_tables(scene, fits, folder)
        save_fit(config, scene, image if source == "image" else None, fit, folder, source)
        true, inferred = shape_factors(scene.truth), shape_factors(fit.energy)
        metrics[source] = {
            "pearson": inference.pearson(true, inferred),
            "relative_error": inference.relative_error(true, inferred),
            "relative_error_initial": fit.history.relative_error[0],
            **runs.fit_metrics(fit),
            "same_neighbours": inference.same_neighbours(fit.tissue, scene.target),
        }
    # The top level has the same keys for all kinds of data.
    return metrics["vertices"] | metrics if both else metrics[config.data]


def make_scene(config: Config) -> tuple[inference.Scene, np.ndarray | None]:
    """Truth, guess and tissues, and the image if it is needed."""
    keys = jax.random.split(jax.random.key(config.seed), 4)
    options: dict[str, Any] = {"guess": config.guess, "response": config.relaxation.build()}
    options |= config.tissue.model_dump() | config.truth.model_dump()
    scene = inference.shape_factor_scene(key=keys[:3], **options)
    microscope = config.image.build(config.image.noise)
    return scene, None if config.data == "vertices" else microscope(scene.target, key=keys[3])


def fit_scene(
    config: Config,
    scene: inference.Scene,
    image: np.ndarray | None,
    source: str,
    folder: runs.RunFolder,
    progress: bool,
) -> Fit:
    """The fit from one kind of data."""
    cost: AbstractCost = VertexDistance(scene.target)
    if source == "image":
        assert image is not None
        cost = MeshImage(image, config.image.psf_width * pixel_size(config, scene))
    # A relaxation keeps the centroid of the vertices; the position in an image is unknown.
    options: Any = {"fit_position": source == "image", "response": config.relaxation.build()}
    problem = InverseProblem(scene.initial, scene.guess, cost, **options)
    optimiser, epochs = config.fit.build(), config.fit.epochs
    return folder.fit(source, problem, optimiser, epochs, truth=scene.truth, progress=progress)


def save_tables(scene: inference.Scene, fits: dict[str, Fit], folder: runs.RunFolder) -> None:
    """Write the shape factors and the histories of all fits."""
    true, initial = shape_factors(scene.truth), shape_factors(scene.guess)
    cells = {"cell": np.arange(len(true)), "true": true, "initial": initial}
    for source, fit in fits.items():
        name = "inferred" if len(fits) == 1 else f"inferred_{source}"
        cells[name] = shape_factors(fit.energy)
    folder.save_table("shape_factors", cells)
    tables = [runs.history_table(fit.history, {"data": source}) for source, fit in fits.items()]
    folder.save_table("history", runs.concatenate(tables))


def save_fit(
    config: Config,
    scene: inference.Scene,
    image: np.ndarray | None,
    fit: Fit,
    folder: runs.RunFolder,
    source: str,
) -> None:
    """Write the tissue and the figures of a fit."""
    ending = f"_{source}" if config.data == "both" else ""
    folder.save_tissue(f"fitted{ending}", fit.tissue)
    panels = {
        "initial guess": (scene.initial, scene.guess),
        "fitted": (fit.tissue, fit.energy),
        "target": (scene.target, scene.truth),
    }
    figure = plot_panels(panels, label=f"target shape factor {NAME}")
    folder.save_figure(f"before_after{ending}", figure)
    plot_history(fit.history, figure=(convergence := Figure()))
    folder.save_figure(f"convergence{ending}", convergence)
    energies = (scene.truth, fit.energy, scene.guess)
    plot_recovery(*map(shape_factors, energies), figure=(recovery := Figure()), name=NAME)
    folder.save_figure(f"recovery{ending}", recovery)
    if image is not None:
        overlay = plot_overlay(image, scene, fit, pixel_size(config, scene))
        folder.save_figure(f"overlay{ending}", overlay)


def shape_factors(energy: Any) -> np.ndarray:
    """The target shape factors."""
    return np.asarray(energy.target_shape_factor, float)


def pixel_size(config: Config, scene: inference.Scene) -> float:
    """The side of a pixel."""
    return config.image.build(config.image.noise).pixel_size(scene.target)


def plot_panels(panels: dict[str, tuple[Any, Any]], *, label: str) -> Figure:
    """Tissues side by side, in the colours of the shape factors of their energies."""
    figure, tissues = Figure(), {title: tissue for title, (tissue, _) in panels.items()}
    values = [shape_factors(energy) for _, energy in panels.values()]
    plot_tissues(tissues, values, figure=figure, label=label)
    return figure


def plot_overlay(image: np.ndarray, scene: inference.Scene, fit: Fit, pixel_size: float) -> Figure:
    """The image alone, and under the mesh of the guess and of the fit."""
    figure = Figure()
    panels = {"image": None, "initial guess": scene.initial, "fitted": fit.tissue}
    axes = plot_tissues(panels, figure=figure, image=image, pixel_size=pixel_size, linewidth=0.9)
    for ax in axes:
        ax.invert_yaxis()  # upwards, as in the other figures of these tissues
    scale_bar(axes[0], "pixels", unit_length=pixel_size)
    return figure
