"""Recover hidden target shape factors of a synthetic tissue from its vertices or an image of it.

A periodic Voronoi tissue gets a target shape factor for each cell, drawn at random, and is relaxed.
What is seen of it (its vertices, or a microscopy image) and its topology are all that the fit is
given; it starts from a guess of the shape factors and has to find the hidden ones (paper,
"Benchmarking bilevel optimization approaches on vertex models").
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from pydantic import Field

from vertax.costs import AbstractCost, MeshImage, VertexDistance
from vertax.energies import AbstractEnergy, ShapeFactorEnergy
from vertax.fitting import Fit, InverseProblem
from vertax.inference import Scene, pearson, relative_error, same_neighbours, shape_factor_scene
from vertax.plotting import plot_history
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    Microscope,
    Relaxation,
    RunFolder,
    ShapeFactors,
    TissueSection,
    fit_metrics,
    history_columns,
    joined,
)

from . import figures

_NAME = r"$p_0$"
_Image = Float[np.ndarray, "rows columns"] | None


class ImageSection(Microscope):
    """The synthetic microscopy image; intensities are relative to the brightest membrane."""

    noise: float = Field(default=0.05, ge=0)
    """Standard deviation of the noise of a pixel."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    data: Literal["vertices", "image", "both"] = "vertices"
    """What the fit is given; both makes one fit from each."""
    guess: Literal["redrawn", "mean"] = "redrawn"
    """Where the fit starts: another draw of the distribution, or its mean in all cells."""
    tissue: TissueSection = TissueSection()
    """The tissue."""
    truth: ShapeFactors = ShapeFactors()
    """Distribution of the hidden shape factors."""
    image: ImageSection = ImageSection()
    """The synthetic microscopy image."""
    fit: Fitting = Fitting()
    """How the parameters are fitted."""
    relaxation: Relaxation = Relaxation()
    """How the tissue is relaxed."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: `pearson`, `relative_error`, `cost_initial`, `cost_final`, `max_force`
    and others of the fit; if there are two kinds of data, those of the vertices and a mapping for
    each.

    **Raises:**

    - `FitError` if a fit cannot go on.
    """
    scene, image = _make_scene(config)
    _save_scene(scene, image, folder)
    both = config.data == "both"
    metrics: dict[str, dict[str, Any]] = {}
    fits: dict[str, Fit] = {}
    for source in ("vertices", "image") if both else (config.data,):
        fits[source] = _fit(config, scene, image, source, folder, progress)
        _save_tables(scene, fits, folder)
        _save_fit(config, scene, image, source, fits[source], folder)
        metrics[source] = _metrics(scene, fits[source])
    # The same keys are at the top whatever the data; the exact data, vertices, come first.
    return metrics["vertices"] | metrics if both else metrics[config.data]


def _make_scene(config: Config) -> tuple[Scene, _Image]:
    keys = jax.random.split(jax.random.key(config.seed), 4)
    scene = shape_factor_scene(
        key=keys[:3],
        guess=config.guess,
        response=config.relaxation.build(),
        **config.tissue.model_dump(),
        **config.truth.model_dump(),
    )
    microscope = config.image.build(config.image.noise)
    return scene, None if config.data == "vertices" else microscope(scene.target, key=keys[3])


def _fit(
    config: Config, scene: Scene, image: _Image, source: str, folder: RunFolder, progress: bool
) -> Fit:
    cost: AbstractCost
    if source == "image":
        assert image is not None
        cost = MeshImage(image, config.image.psf_width * _pixel_size(config, scene))
    else:
        cost = VertexDistance(scene.target)
    problem = InverseProblem(
        scene.initial,
        scene.guess,
        cost,
        # Vertices keep their centroid while they relax; an image does not say where it was.
        fit_position=source == "image",
        response=config.relaxation.build(),
    )
    optimiser, epochs = config.fit.build(), config.fit.epochs
    return folder.fit(source, problem, optimiser, epochs, truth=scene.truth, progress=progress)


def _metrics(scene: Scene, outcome: Fit) -> dict[str, Any]:
    true, inferred = _parameters(scene.truth), _parameters(outcome.energy)
    return {
        "pearson": pearson(true, inferred),
        "relative_error": relative_error(true, inferred),
        "relative_error_initial": outcome.history.relative_error[0],
        **fit_metrics(outcome),
        "same_neighbours": same_neighbours(outcome.tissue, scene.target),
    }


def _save_scene(scene: Scene, image: _Image, folder: RunFolder) -> None:
    folder.save_tissue("target", scene.target)
    folder.save_tissue("initial", scene.initial)
    panels = {"target": (scene.target, _parameters(scene.truth))}
    folder.save_figure("target", figures.tissues(panels, label=f"true {_NAME}"))
    if image is not None:
        folder.save_array("image", image)


def _save_tables(scene: Scene, fits: dict[str, Fit], folder: RunFolder) -> None:
    inferred = {
        "inferred" if len(fits) == 1 else f"inferred_{source}": _parameters(outcome.energy)
        for source, outcome in fits.items()
    }
    true, initial = _parameters(scene.truth), _parameters(scene.guess)
    cells = {"cell": np.arange(len(true)), "true": true, "initial": initial} | inferred
    folder.save_table("shape_factors", cells)
    tables = [history_columns(outcome.history, data=source) for source, outcome in fits.items()]
    folder.save_table("history", joined(tables))


def _save_fit(
    config: Config, scene: Scene, image: _Image, source: str, outcome: Fit, folder: RunFolder
) -> None:
    ending = f"_{source}" if config.data == "both" else ""
    folder.save_tissue(f"fitted{ending}", outcome.tissue)
    true, inferred, initial = map(_parameters, (scene.truth, outcome.energy, scene.guess))
    panels = {
        "initial guess": (scene.initial, initial),
        "fitted": (outcome.tissue, inferred),
        "target": (scene.target, true),
    }
    label = f"target shape factor {_NAME}"
    folder.save_figure(f"before_after{ending}", figures.tissues(panels, label=label))
    convergence = Figure()
    plot_history(outcome.history, figure=convergence)
    folder.save_figure(f"convergence{ending}", convergence)
    folder.save_figure(f"recovery{ending}", figures.recovery(true, inferred, initial, name=_NAME))
    if source == "image" and image is not None:
        overlays = {"image": None, "initial guess": scene.initial, "fitted": outcome.tissue}
        pixel = _pixel_size(config, scene)
        figure = figures.overlays(image, overlays, pixel_size=pixel)
        folder.save_figure(f"overlay{ending}", figure)


def _parameters(energy: AbstractEnergy) -> Float[np.ndarray, " cells"]:
    assert isinstance(energy, ShapeFactorEnergy)
    return np.asarray(energy.target_shape_factor, float)


def _pixel_size(config: Config, scene: Scene) -> float:
    return config.image.build(config.image.noise).pixel_size(scene.target)
