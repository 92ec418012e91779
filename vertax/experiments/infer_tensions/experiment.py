"""Relative tensions and pressures of a tissue, with their errors, from its geometry alone.

A tissue is seen as a segmented image: outlines of its cells, or labels. Each of its edges becomes an arc, and
tensions and pressures are those that balance at junctions between three cells and along arcs. A shape tells
them but for one factor: they are given relative to the mean tension. Without an image a cluster of known
tensions is drawn and segmented, to see how well they are found.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, Shaped
from pydantic import Field

from vertax._base.pixels import pixel_length
from vertax.energies import LocalSum
from vertax.inference import (
    InferredTensions,
    foam_energy,
    foam_terms,
    infer_tensions,
    label_image,
    pearson,
    read_mask,
)
from vertax.initialise import free_voronoi
from vertax.io import write_geojson
from vertax.mesh import Tissue
from vertax.plotting import label_colours
from vertax.runs import ExperimentConfig, ImageFile, Relaxation, RunFolder, Section

from . import figures

SYNTHETIC = "synthetic"


class ImageSection(ImageFile):
    """The segmented image."""

    path: str | None = SYNTHETIC
    """The file: TIFF, PNG, NPY; or synthetic, the image of a cluster that is drawn."""
    kind: Literal["auto", "outlines", "labels"] = "auto"
    """Whether it shows the outlines of cells, or a number or colour in each pixel of a cell; `"auto"` takes
    an image of two values for outlines."""
    background: int | None = None
    """The label of what is no cell, if it is not 0 and does not lie around all others."""
    gap_width: float | None = Field(default=None, ge=0)
    """Largest width of a line between two cells in contact, in pixels; left out, it is measured."""
    holes: Literal["keep", "close"] = "keep"
    """Whether holes stay faces without a cell, or are given to the cells next to them."""
    pixel_size: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Height and width of a pixel that is not square; left out, as the resolution of a TIFF file gives it."""

    def source(self) -> str | Shaped[np.ndarray, "rows columns"]:
        """The file, or the pixels of the channel that is chosen."""
        return self.read() if self.channel is not None or self.path is None else self.path

    def labels(self) -> Int[np.ndarray, "rows columns"]:
        """A label for each pixel."""
        return read_mask(self.source(), **self.reading())

    def reading(self) -> dict[str, Any]:
        """Arguments of `read_mask`."""
        plane = self.plane if self.channel is None else None
        return {"kind": self.kind, "background": self.background, "plane": plane}

    def tensions(self, image: Any, **options: Any) -> InferredTensions:
        """The tensions of an image, read as this section says."""
        size = None if self.pixel_size is None else (self.pixel_size[0], self.pixel_size[1])
        options |= {"gap_width": self.gap_width, "holes": self.holes, "pixel_size": size}
        return infer_tensions(image, **options)


class Cluster(Section):
    """The synthetic cluster, and its image."""

    n_cells: int = Field(default=16, ge=6)
    """Number of cells."""
    deviation: float = Field(default=0.2, ge=0, lt=0.5)
    """Standard deviation of the tensions, of mean 1."""
    stiffness: float = Field(default=20.0, gt=0)
    """Stiffness of the areas, relative to the mean tension."""
    pixels: int = Field(default=800, ge=64)
    """Longer side of the image, in pixels."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    image: ImageSection = ImageSection()
    """The segmented image."""
    cluster: Cluster = Cluster()
    """What is drawn if the image is synthetic."""
    noise: float | None = Field(default=None, gt=0)
    """Standard deviation of the position of an edge, in pixels; left out, how far pixels are from arcs."""
    prior: float | None = Field(default=None, gt=0)
    """Standard deviation of relative tensions before the image was seen; left out, twice as
    much as they differ."""


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: not used; nothing takes long.

    **Returns:** the metrics: how many tensions and pressures are determined, their spread and uncertainty,
    the noise of the image and how far the tissue is from a balance; for a synthetic cluster how well they
    were found. What speaks against believing them is a warning.

    **Raises:**

    - `FileNotFoundError` and `ValueError` for an image that cannot be used.
    """
    truth = None
    if config.image.path != SYNTHETIC:
        labels = config.image.labels()
        source, options = config.image.source(), config.image.reading()
    else:
        truth, labels = _synthetic(config)
        source, options = labels, dict[str, Any](kind="labels")
    options["prior"] = config.prior
    found = config.image.tensions(source, **options)
    if config.noise is not None and found.pixel_size is not None:
        noise = config.noise * pixel_length(found.pixel_size)
        found = config.image.tensions(source, noise=noise, **options)
    for doubt in found.doubts:
        folder.warn(doubt)
    folder.save_tissue("seen", found.tissue)
    edges, cells = found.edge_table(), found.cell_table()
    if truth is not None:
        _add_truth(found, truth, edges, cells)
    folder.save_table("edges", edges)
    folder.save_table("cells", cells)
    if found.mask_report is not None:
        folder.save_table("changes", found.mask_report.change_table())
    write_geojson(
        folder.path / "cells.geojson",
        found.tissue,
        cells={name: cells[name] for name in ("label", "pressure", "pressure_deviation")},
        edges={name: edges[name] for name in ("tension", "tension_deviation", "determined")},
    )
    folder.save_figure("tensions", figures.foam(label_colours(labels), found))
    if truth is not None and found.determined.any():
        folder.save_figure("recovery", figures.recovery(edges, cells))
    return _metrics(found, edges, cells)


def _synthetic(config: Config) -> tuple[tuple[LocalSum, Tissue], Int[np.ndarray, "rows columns"]]:
    """A cluster in equilibrium with its energy, and its label image."""
    options = config.cluster
    shape_key, tension_key, area_key = jax.random.split(jax.random.key(config.seed), 3)
    cluster = free_voronoi(options.n_cells, key=shape_key, lloyd_steps=3, inner_arcs=True)
    # Tensions between half and one and a half: at every junction of three they can balance.
    tension = 1 + options.deviation * jax.random.truncated_normal(
        tension_key, -0.5 / options.deviation, 0.5 / options.deviation, (cluster.n_edges,)
    )
    areas = jax.random.uniform(area_key, (options.n_cells,), minval=0.9, maxval=1.3)
    energy = foam_energy(
        tension / jnp.mean(tension), areas, stiffness=options.stiffness, low=0.05, high=4.0
    )
    relaxed = Relaxation().build()(cluster, energy).tissue
    return (energy, relaxed), label_image(relaxed, options.pixels)


def _add_truth(
    found: InferredTensions,
    truth: tuple[LocalSum, Tissue],
    edges: dict[str, np.ndarray],
    cells: dict[str, np.ndarray],
) -> None:
    """Add the true tensions and pressures of what is determined, in the units of what was found."""
    energy, relaxed = truth
    area, tension = foam_terms(energy)
    # Labels are the numbers of the true cells, from 1.
    number = np.append(np.arange(1, relaxed.n_cells + 1), 0)
    true_between = np.sort(number[np.asarray(relaxed.topology.edge_cells)], axis=1)
    between = np.sort(np.stack([edges["left_label"], edges["right_label"]], axis=1), axis=1)
    by_pair: dict[tuple[int, ...], list[float]] = {}
    for pair, value in zip(true_between.tolist(), np.asarray(tension.tension), strict=True):
        by_pair.setdefault(tuple(pair), []).append(float(value))
    # Two cells may meet in two edges, which then cannot be told apart.
    single = [by_pair.get(tuple(pair), []) for pair in between.tolist()]
    true = np.array([v[0] if len(v) == 1 else np.nan for v in single])
    seen = true[found.determined & np.isfinite(true)]
    mean = seen.mean() if seen.size else 1.0
    edges["true_tension"] = np.where(found.determined, true / mean, np.nan)
    length = np.sqrt(np.mean(np.asarray(relaxed.areas)) / np.mean(cells["area"]))
    pressure = np.asarray(area.pressures(relaxed))[np.asarray(found.labels) - 1] / mean * length
    known = found.pressures_determined
    cells["true_pressure"] = np.where(
        known, pressure - np.sum(pressure[known]) / max(1, known.sum()), np.nan
    )


def _metrics(
    found: InferredTensions, edges: dict[str, np.ndarray], cells: dict[str, np.ndarray]
) -> dict[str, Any]:
    pixel = pixel_length(found.pixel_size or 1.0)
    cells_only = found.labels > 0
    metrics: dict[str, Any] = {
        "n_cells": int(cells_only.sum()),
        "n_holes": int(np.sum(~cells_only)),
        "n_edges": found.tissue.n_edges,
        "n_tensions_determined": int(found.determined.sum()),
        "n_pressures_determined": int(found.pressures_determined.sum()),
        "pixel_size": pixel,
        "noise_pixels": found.noise / pixel,
        "noise_correlation_pixels": found.correlation / pixel,
        "bending_degrees": np.degrees(found.bending),
        "doubts": found.doubts,
        "area_error_max": float(np.max(np.abs(found.area_errors[cells_only]))),
        "out_of_balance_degrees_junctions": np.degrees(found.model_errors[0]),
        "out_of_balance_degrees_arcs": np.degrees(found.model_errors[1]),
    }
    if found.mask_report is not None:
        metrics |= {f"mask_{name}": value for name, value in found.mask_report.summary().items()}
    for name, values, sure in (
        ("tension", edges, found.determined),
        ("pressure", cells, found.pressures_determined),
    ):
        if not sure.any():
            continue
        inferred, deviation = values[name][sure], values[f"{name}_deviation"][sure]
        metrics[f"{name}_min"], metrics[f"{name}_max"] = inferred.min(), inferred.max()
        metrics[f"{name}_std"] = inferred.std()
        metrics[f"{name}_deviation_median"] = np.median(deviation)
        if f"true_{name}" in values:
            true = values[f"true_{name}"][sure]
            known = np.isfinite(true)
            away = (inferred - true)[known]
            metrics[f"pearson_{name}"] = pearson(true[known], inferred[known])
            metrics[f"rms_error_{name}"] = np.sqrt(np.mean(away**2))
            metrics[f"{name}_within_two_deviations"] = np.mean(np.abs(away) < 2 * deviation[known])
    return metrics
