"""Infer relative tensions and pressures of a cluster from its segmented image.

The image has outlines of cells, or labels. Each edge becomes an arc; tensions and pressures balance at the
junctions of three cells and along arcs. A shape determines them up to one factor: they are relative to the
mean tension. Without an image a cluster of given tensions is drawn and segmented, and the results are
compared.
"""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from pydantic import Field

from vertax import inference, plotting, runs
from vertax.initialise import MaskReport, free_voronoi
from vertax.io import pixel_sides, write_geojson

SYNTHETIC = "synthetic"
# Without the palest end, which looks like no colour.
PRESSURES = ListedColormap(colormaps["Blues"](np.linspace(0.15, 1, 256)), "pressures")
TENSION = r"tension $\gamma / \bar\gamma$"
PRESSURE = r"pressure $(p - \bar p)\,\sqrt{\bar A}\,/\,\bar\gamma$"


class ImageSection(runs.ImageFile):
    """The segmented image."""

    path: str | None = Field(default=SYNTHETIC, min_length=1)
    """The file: TIFF, PNG, NPY; or synthetic, the image of a random cluster."""
    kind: Literal["auto", "outlines", "labels"] = "auto"
    """Outlines of cells, or a number or colour in each pixel of a cell; `"auto"` takes an image of two values
    for outlines."""
    background: int | None = None
    """The label of the background, if it is not 0 and not the region around all others."""
    gap_width: float | None = Field(default=None, ge=0)
    """Largest width of a line between two cells in contact, in pixels; left out, it is measured."""
    holes: Literal["keep", "close"] = "keep"
    """Whether holes stay faces without a cell, or are given to the cells next to them."""
    pixel_size: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Height and width of a pixel that is not square; left out, from the resolution of a TIFF file."""

    def source(self) -> Any:
        """The file, or the pixels of the channel that is chosen."""
        return self.read() if self.channel is not None or self.path is None else self.path

    def labels(self) -> np.ndarray:
        """A label for each pixel."""
        return inference.read_mask(self.source(), **self.reading())

    def reading(self) -> dict[str, Any]:
        """Arguments of `read_mask`."""
        plane = self.plane if self.channel is None else None
        return {"kind": self.kind, "background": self.background, "plane": plane}

    def tensions(self, image: Any, **options: Any) -> inference.InferredTensions:
        """The tensions of an image, read as this section specifies."""
        size = None if self.pixel_size is None else (self.pixel_size[0], self.pixel_size[1])
        options |= {"gap_width": self.gap_width, "holes": self.holes, "pixel_size": size}
        return inference.infer_tensions(image, **options)


class Cluster(runs.Section):
    """The synthetic cluster and its image."""

    n_cells: int = Field(default=16, ge=6)
    """Number of cells."""
    deviation: float = Field(default=0.2, ge=0, lt=0.5)
    """Standard deviation of the tensions, of mean 1."""
    stiffness: float = Field(default=20.0, gt=0)
    """Stiffness of the areas, relative to the mean tension."""
    pixels: int = Field(default=800, ge=64)
    """Longer side of the image, in pixels."""


class Config(runs.ExperimentConfig):
    """Configuration of this job."""

    image: ImageSection = ImageSection()
    """The segmented image."""
    cluster: Cluster = Cluster()
    """The cluster of a synthetic image."""
    noise: float | None = Field(default=None, gt=0)
    """Standard deviation of the position of an edge, in pixels; left out, the distance of pixels to arcs."""
    prior: float | None = Field(default=None, gt=0)
    """Standard deviation of relative tensions without the image; left out, twice as much as they differ."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Infer tensions and pressures.

    **Returns:** the metrics: numbers of determined tensions and pressures, their spread and uncertainty,
    noise of the image and distance from balance; for a synthetic cluster also the errors.
    """
    del progress
    truth: Any = None
    options: dict[str, Any]
    if config.image.path != SYNTHETIC:
        source, options = config.image.source(), config.image.reading()
        labels = config.image.labels()
    else:
        truth, labels = draw_cluster(config)
        source, options = labels, {"kind": "labels"}
    options["prior"] = config.prior
    result = config.image.tensions(source, **options)
    if config.noise is not None and result.pixel_size is not None:
        options["noise"] = config.noise * np.sqrt(np.prod(pixel_sides(result.pixel_size)))
        result = config.image.tensions(source, **options)
    for doubt in result.doubts:
        folder.warn(doubt)
    folder.save_tissue("seen", result.tissue)
    edges, cells = result.edge_table(), result.cell_table()
    if truth is not None:
        add_truth(result, truth[0], truth[1], edges, cells)
    folder.save_table("edges", edges)
    folder.save_table("cells", cells)
    if result.mask_report is not None:
        folder.save_table("changes", result.mask_report.change_table())
    write_geojson(
        folder.path / "cells.geojson",
        result.tissue,
        cells={name: cells[name] for name in ("label", "pressure", "pressure_deviation")},
        edges={name: edges[name] for name in ("tension", "tension_deviation", "determined")},
    )
    folder.save_figure("tensions", plot_foam(plotting.label_colours(labels), result))
    if truth is not None and result.determined.any():
        folder.save_figure("recovery", plot_recovery(edges, cells))
    return measure(result, edges, cells)


def draw_cluster(config: Config) -> tuple[tuple[Any, Any], np.ndarray]:
    """The energy of a cluster and the cluster at equilibrium, and its label image."""
    options = config.cluster
    shape_key, tension_key, area_key = jax.random.split(jax.random.key(config.seed), 3)
    cluster = free_voronoi(options.n_cells, key=shape_key, lloyd_steps=3, inner_arcs=True)
    # Three tensions between 0.5 and 1.5 can balance at any junction.
    limit = 0.5 / options.deviation
    noise = jax.random.truncated_normal(tension_key, -limit, limit, (cluster.n_edges,))
    tension = 1 + options.deviation * noise
    areas = jax.random.uniform(area_key, (options.n_cells,), minval=0.9, maxval=1.3)
    bounds: dict[str, Any] = {"stiffness": options.stiffness, "low": 0.05, "high": 4.0}
    energy = inference.foam_energy(tension / jnp.mean(tension), areas, **bounds)
    relaxed = runs.RelaxationSection().build()(cluster, energy).tissue
    return (energy, relaxed), inference.label_image(relaxed, options.pixels)


def add_truth(
    result: inference.InferredTensions, energy: Any, tissue: Any, edges: Any, cells: Any
) -> None:
    """Add the true values of determined tensions and pressures, in the units of the inferred ones."""
    area, line = inference.foam_terms(energy)
    # A label is the index of the true cell plus 1.
    number = np.append(np.arange(1, tissue.n_cells + 1), 0)
    true_pairs = np.sort(number[np.asarray(tissue.topology.edge_cells)], axis=1)
    pairs = np.sort(np.stack([edges["left_label"], edges["right_label"]], axis=1), axis=1)
    by_pair: dict[tuple[int, ...], list[float]] = {}
    for pair, value in zip(true_pairs.tolist(), np.asarray(line.tension), strict=True):
        by_pair.setdefault(tuple(pair), []).append(float(value))
    # The two edges of a pair of cells that share two have the same labels.
    values = [by_pair.get(tuple(pair), []) for pair in pairs.tolist()]
    true = np.array([v[0] if len(v) == 1 else np.nan for v in values])
    compared = true[result.determined & np.isfinite(true)]
    mean = compared.mean() if compared.size else 1.0
    edges["true_tension"] = np.where(result.determined, true / mean, np.nan)
    length = np.sqrt(np.mean(np.asarray(tissue.areas)) / np.mean(cells["area"]))
    pressure = np.asarray(area.pressures(tissue))[np.asarray(result.labels) - 1] / mean * length
    determined = result.pressures_determined
    offset = np.sum(pressure[determined]) / max(1, determined.sum())
    cells["true_pressure"] = np.where(determined, pressure - offset, np.nan)


def measure(result: inference.InferredTensions, edges: Any, cells: Any) -> dict[str, Any]:
    """The metrics."""
    pixel = float(np.sqrt(np.prod(pixel_sides(result.pixel_size or 1.0))))
    is_cell = result.labels > 0
    metrics: dict[str, Any] = {
        "n_cells": int(is_cell.sum()),
        "n_holes": int(np.sum(~is_cell)),
        "n_edges": result.tissue.n_edges,
        "n_tensions_determined": int(result.determined.sum()),
        "n_pressures_determined": int(result.pressures_determined.sum()),
        "pixel_size": pixel,
        "noise_pixels": result.noise / pixel,
        "noise_correlation_pixels": result.correlation / pixel,
        "bending_degrees": np.degrees(result.bending),
        "doubts": result.doubts,
        "area_error_max": float(np.max(np.abs(result.area_errors[is_cell]))),
        "out_of_balance_degrees_junctions": np.degrees(result.model_errors[0]),
        "out_of_balance_degrees_arcs": np.degrees(result.model_errors[1]),
    }
    if result.mask_report is not None:
        summary = result.mask_report.summary()
        metrics |= {f"mask_{name}": value for name, value in summary.items()}
    for name, table, determined in (
        ("tension", edges, result.determined),
        ("pressure", cells, result.pressures_determined),
    ):
        if not determined.any():
            continue
        inferred, deviation = table[name][determined], table[f"{name}_deviation"][determined]
        metrics[f"{name}_min"], metrics[f"{name}_max"] = inferred.min(), inferred.max()
        metrics[f"{name}_std"] = inferred.std()
        metrics[f"{name}_deviation_median"] = np.median(deviation)
        if f"true_{name}" in table:
            true = table[f"true_{name}"][determined]
            finite = np.isfinite(true)
            error = (inferred - true)[finite]
            metrics[f"pearson_{name}"] = inference.pearson(true[finite], inferred[finite])
            metrics[f"rms_error_{name}"] = np.sqrt(np.mean(error**2))
            within = np.abs(error) < 2 * deviation[finite]
            metrics[f"{name}_within_two_deviations"] = np.mean(within)
    return metrics


@plotting.house_style()
def plot_foam(image: np.ndarray, result: inference.InferredTensions) -> Figure:
    """The image with the arcs, and a map of tensions and pressures; grey where they are not determined.

    On the image the sides of holes are dashed, contacts that the mask does not show are dotted, and a ring
    marks each place where the mask was changed.
    """
    rows, columns = image.shape[:2]
    height, size = max(3.4 * rows / columns + 0.5, 2.4), result.pixel_size or 1.0
    figure, ((left, right),) = plotting.new_figure(1, 2, width=3.6, height=height, room=1.2)
    plotting.plot_tissue(result.tissue, ax=left, image=image, pixel_size=size)
    left.set_title("arcs over the image")
    plotting.scale_bar(left, "pixels", unit_length=pixel_sides(size)[0])
    if result.mask_report is not None:
        draw_report(left, result, result.mask_report)
    pressures = np.where(result.pressures_determined, result.pressures, np.nan)
    tensions = np.where(result.determined, result.tensions, np.nan)
    style: Any = {"cmap": PRESSURES, "label": PRESSURE, "edge_label": TENSION}
    plotting.plot_tissue(result.tissue, pressures, tensions, ax=right, **style)
    # The y axis points down, as in the image.
    right.set(xlim=left.get_xlim(), ylim=left.get_ylim())
    right.set_title("tensions and pressures")
    return figure


def draw_report(ax: Any, result: inference.InferredTensions, report: MaskReport) -> None:
    """Mark holes, contacts that the mask does not show, and places where the mask was changed."""
    sides = pixel_sides(result.pixel_size or 1.0)
    points = np.asarray(result.tissue.edge_points(jnp.linspace(0.0, 1.0, 13)), float)
    edge_cells = np.asarray(result.tissue.topology.edge_cells)
    between = np.append(result.labels, 0)[edge_cells]
    hole = np.append(result.labels == 0, False)[edge_cells].any(1)
    hidden = report.closed & np.all(between > 0, axis=1)
    for which, style in ((hidden, ":"), (hole, "--")):
        if which.any():
            lines = LineCollection(list(points[which]), colors="w", linestyles=style, lw=1.5)
            ax.add_collection(lines)
    median = np.median(report.pixels)
    for change in report.changes:
        area = max(change.pixels, 0.01 * median) * sides.prod()
        radius = max(3.0 * sides.min(), np.sqrt(area / np.pi))
        place = (sides[0] * change.column, sides[1] * change.row)
        ax.add_patch(Circle(place, radius, fill=False, ec="r", lw=1.0))


@plotting.house_style()
def plot_recovery(edges: Any, cells: Any) -> Figure:
    """Inferred against true tensions and pressures."""
    figure, ((left, right),) = plotting.new_figure(1, 2, width=2.9, height=2.7)
    for ax, table, key, name in (
        (left, edges, "tension", TENSION),
        (right, cells, "pressure", PRESSURE),
    ):
        options: Any = {"deviation": table[f"{key}_deviation"], "ax": ax, "name": name}
        plotting.plot_recovery(table[f"true_{key}"], table[key], **options)
    return figure
