"""Relative tensions and pressures of a cluster of cells, from its geometry alone.

A free cluster is seen as a segmented image: outlines of its cells, or labels. Each of its edges becomes
an arc, and the foam model E2 (a tension in each edge, a pressure in each cell) is fitted until its
equilibrium has the edges that were seen. A shape tells tensions and pressures but for one factor: they
are given relative to the mean tension. Without an image a cluster of known tensions is drawn and
segmented, to see how well they are found.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Int
from pydantic import Field, model_validator

from vertax.energies import LocalSum
from vertax.fitting import Fit
from vertax.inference import (
    TensionProblem,
    Tensions,
    foam_energy,
    foam_terms,
    force_balance,
    label_image,
    pearson,
    tension_problem,
)
from vertax.initialise import Segmentation, free_voronoi, from_labels, labels_from_skeleton
from vertax.mesh import Tissue
from vertax.plotting import label_colours
from vertax.runs import (
    ExperimentConfig,
    ImageFile,
    Relaxation,
    RunFolder,
    Section,
    fit_metrics,
    history_columns,
)

from . import figures


class ImageSection(ImageFile):
    """The segmented image; without a file, one of a synthetic cluster."""

    kind: Literal["skeleton", "labels"] = "skeleton"
    """Whether it shows the outlines of cells, or a number in each pixel of a cell."""


class Cluster(Section):
    """The synthetic cluster, and its image."""

    n_cells: int = Field(default=16, ge=4)
    """Number of cells."""
    deviation: float = Field(default=0.2, ge=0, lt=0.5)
    """Standard deviation of the tensions, of mean 1."""
    pixels: int = Field(default=800, ge=64)
    """Longer side of the image, in pixels."""


class Foam(Section):
    """The foam model, relative to the mean tension."""

    stiffness: float = Field(default=20.0, gt=0)
    """Stiffness of the areas."""
    low: float = Field(default=0.05, ge=0, lt=1)
    """Least relative tension."""
    high: float = Field(default=4.0, gt=1)
    """Largest relative tension."""


class Model(Foam):
    """The foam model, and how much the image counts."""

    inner_arcs: bool = True
    """Whether edges between two cells are arcs too, whose curvature tells differences of pressure."""
    prior: float = Field(default=0.5, gt=0)
    """Standard deviation of relative tensions before the image was seen; it decides what the geometry
    leaves open."""
    noise: float = Field(default=1.0, gt=0)
    """Standard deviation of the position of an edge, in pixels: how much the image counts against that."""

    def foam(self) -> dict[str, float]:
        """Stiffness and bounds of the tensions, by name."""
        return {name: getattr(self, name) for name in Foam.model_fields}


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    image: ImageSection = ImageSection()
    """The segmented image."""
    cluster: Cluster = Cluster()
    """What is drawn if there is no image."""
    model: Model = Model()
    """What is fitted."""
    epochs: int = Field(default=30, ge=1)
    """Most steps of Levenberg and Marquardt."""
    relaxation: Relaxation = Relaxation(transitions=False)
    """How the cluster is relaxed; it has the neighbours that the image shows."""

    @model_validator(mode="after")
    def _without_transitions(self) -> Config:
        if self.relaxation.transitions:
            raise ValueError(
                "relaxation.transitions must be false: edges are compared one by one with those of the "
                "image"
            )
        return self


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: distances of the edges from those of the image in pixels (for tensions that
    are all equal, those that balance forces best in the shape as it was seen, and the fitted ones),
    spread and uncertainty of tensions and pressures; for a synthetic cluster how well they were found.
    Edges that are further from those of the image than the noise allows are a warning.

    **Raises:**

    - `FileNotFoundError` and `ValueError` for an image that cannot be used; `FitError` if the fit cannot
        go on.
    """
    truth = None
    if config.image.path:
        image = config.image.read()
        labels = labels_from_skeleton(image) if config.image.kind == "skeleton" else image
    else:
        truth, labels = _synthetic(config)
        image = labels
    model = config.model
    found = from_labels(labels, boundary="free", inner_arcs=model.inner_arcs)
    folder.save_tissue("target", found.tissue)
    foam = tension_problem(
        found,
        prior=model.prior,
        noise=model.noise,
        response=config.relaxation.build(),
        **model.foam(),
    )
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    outcome = folder.fit("tensions", foam.problem, solver, config.epochs, progress=progress)
    folder.save_tissue("fitted", outcome.tissue)
    folder.save_table("history", history_columns(outcome.history))
    result = foam.tensions(outcome)
    edges, cells = _tables(found, outcome, result, truth)
    folder.save_table("edges", edges)
    folder.save_table("cells", cells)
    # Labels differ by their colours, and outlines are light on dark.
    picture = label_colours(labels) if image is labels else np.asarray(image != 0, float)
    tensions, pressures = result.tension, result.pressure
    figure = figures.foam(picture, found, outcome.tissue, tensions, pressures)
    folder.save_figure("tensions", figure)
    if truth is not None:
        folder.save_figure("recovery", figures.recovery(edges, cells))
    metrics = _metrics(config, foam, outcome, result, edges, cells)
    _check(config, metrics, folder)
    return metrics


def _check(config: Config, metrics: dict[str, Any], folder: RunFolder) -> None:
    """Say so if the model does not have the edges of the image."""
    noise, inner = config.model.noise, metrics["rms_distance_pixels_inner"]
    everywhere = metrics["rms_distance_pixels_fitted"]
    if inner > 2 * noise:
        folder.warn(
            f"the fitted edges do not explain the image: those between cells are {inner:.1f} pixels off, "
            f"root mean square, where model.noise is {noise:g}; the tensions are not to be trusted"
        )
    elif everywhere > 2 * noise:
        folder.warn(
            f"the outline of the fitted cluster is not that of the image: all edges are {everywhere:.1f} "
            f"pixels off, root mean square, those between cells {inner:.1f}; tensions of the outline are "
            "not to be trusted"
        )


def _synthetic(config: Config) -> tuple[tuple[LocalSum, Tissue], Int[np.ndarray, "rows columns"]]:
    """A cluster in equilibrium with its energy, and its label image."""
    model, options = config.model, config.cluster
    shape_key, tension_key, area_key = jax.random.split(jax.random.key(config.seed), 3)
    cluster = free_voronoi(
        options.n_cells, key=shape_key, lloyd_steps=3, inner_arcs=model.inner_arcs
    )
    # Tensions between half and one and a half: at every junction of three they can balance.
    tension = 1 + options.deviation * jax.random.truncated_normal(
        tension_key, -0.5 / options.deviation, 0.5 / options.deviation, (cluster.n_edges,)
    )
    areas = jax.random.uniform(area_key, (options.n_cells,), minval=0.9, maxval=1.3)
    energy = foam_energy(tension / jnp.mean(tension), areas, **model.foam())
    relaxed = Relaxation().build()(cluster, energy).tissue
    return (energy, relaxed), label_image(relaxed, options.pixels)


def _tables(
    found: Segmentation, outcome: Fit, result: Tensions, truth: tuple[LocalSum, Tissue] | None
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A row an edge, and a row a cell; the exterior is label 0."""
    tissue = outcome.tissue
    labels = np.append(found.labels, 0)
    between = np.sort(labels[np.asarray(tissue.topology.edge_cells)], axis=1)
    edges = {
        "label": between[:, 0],
        "other_label": between[:, 1],
        "length": np.asarray(tissue.edge_lengths),
        "tension": result.tension,
        "tension_deviation": result.tension_deviation,
    }
    cells = {
        "label": np.asarray(found.labels),
        "area": np.asarray(tissue.areas),
        "pressure": result.pressure,
        "pressure_deviation": result.pressure_deviation,
    }
    if truth is not None:
        energy, relaxed = truth
        area, tension = foam_terms(energy)
        # Labels are the numbers of the true cells, from 1.
        number = np.append(np.arange(1, relaxed.n_cells + 1), 0)
        true_between = np.sort(number[np.asarray(relaxed.topology.edge_cells)], axis=1)
        by_pair: dict[tuple[int, ...], list[float]] = {}
        for pair, value in zip(true_between.tolist(), np.asarray(tension.tension), strict=True):
            by_pair.setdefault(tuple(pair), []).append(float(value))
        # Two cells may meet in two edges, which then cannot be told apart.
        single = [by_pair.get(tuple(pair), []) for pair in between.tolist()]
        true_tension = np.array([v[0] if len(v) == 1 else np.nan for v in single])
        true_pressure = np.asarray(area.pressures(relaxed))[np.asarray(found.labels) - 1]
        # Both have the mean tension 1 of all edges, and units of length of their own.
        edges["true_tension"] = true_tension
        cells["true_pressure"] = true_pressure * np.sqrt(np.mean(np.asarray(relaxed.areas)))
    return edges, cells


def _metrics(
    config: Config,
    foam: TensionProblem,
    outcome: Fit,
    result: Tensions,
    edges: dict[str, np.ndarray],
    cells: dict[str, np.ndarray],
) -> dict[str, Any]:
    found = foam.segmentation
    equal = force_balance(found.tissue, prior=1e-3, **config.model.foam())
    distances = foam.distances(equal, foam.balanced, outcome.energy)
    names = ("equal", "balanced", "fitted")
    metrics: dict[str, Any] = {
        f"rms_distance_pixels_{name}": x for name, x in zip(names, distances, strict=True)
    }
    metrics |= {
        "rms_distance_pixels_inner": foam.inner_distance(outcome),
        "n_cells": found.tissue.n_cells,
        "n_edges": found.tissue.n_edges,
        "pixel_size": found.pixel_size,
        "tension_min": result.tension.min(),
        "tension_max": result.tension.max(),
    }
    for name, values in (("tension", edges), ("pressure", cells)):
        metrics[f"{name}_std"] = values[name].std()
        metrics[f"{name}_deviation_median"] = np.median(values[f"{name}_deviation"])
        if f"true_{name}" in values:
            true = values[f"true_{name}"]
            known = np.isfinite(true)
            metrics[f"pearson_{name}"] = pearson(true[known], values[name][known])
            metrics[f"rms_error_{name}"] = np.sqrt(np.mean((values[name] - true)[known] ** 2))
    return metrics | fit_metrics(outcome)
