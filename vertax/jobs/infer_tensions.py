"""Infer relative tensions and pressures of a cluster from its segmented image.

The image has outlines of cells, or labels. Each edge becomes an arc; tensions and pressures balance at the
junctions of three cells and along arcs. A shape determines them up to one factor: they are relative to the
mean tension. Without an image a cluster of given tensions is drawn and segmented, and the results are
compared. A folder, a pattern such as masks/*.tif or a movie gives one table of all masks.
"""

from collections.abc import Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field, model_validator

from vertax import inference, plotting, runs
from vertax.energies import foam_energy
from vertax.initialise import free_voronoi
from vertax.io import pixel_sides, write_geojson
from vertax.tensions import (
    InferredTensions,
    MaskFrame,
    TensionsOfMasks,
    find_masks,
    infer_tensions_of_masks,
)

SYNTHETIC = "synthetic"


class ImageSection(runs.ImageFile):
    """The segmented image."""

    path: str | None = Field(default=SYNTHETIC, min_length=1)
    """The file: TIFF, PNG, NPY; a folder, a pattern (masks/*.tif) or a movie; or synthetic, the image of a
    random cluster."""
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
    """Height and width of a pixel; left out, pixels are square unless the resolution of a TIFF file says
    otherwise, and the mean area of a cell is 1."""
    height: str | None = Field(default=None, min_length=1)
    """Of a curved tissue, the image of the height of each pixel (TIFF or NPY); NaN where it is unknown."""
    plane_distance: float = Field(default=1.0, gt=0)
    """Height per unit of that image, in the unit of `pixel_size`; without that, in pixels."""
    unknown_height: float | None = None
    """Value of unknown pixels in that image, such as 0, beside NaN."""

    @model_validator(mode="before")
    @classmethod
    def _path_alone(cls, value: Any) -> Any:
        return {"path": value} if isinstance(value, str) else value

    def frames(self) -> list[MaskFrame]:
        """The masks."""
        assert self.path is not None  # TOML has no null
        plane = self.plane if self.channel is None else self.plane or 0
        try:
            files = find_masks(self.path, plane=plane)
        except FileNotFoundError as error:
            text = str(error).replace("Argument `masks`", "`image.path`")
            raise runs.ConfigError(text) from error
        if self.channel is None:
            return files
        read = lambda file: self.model_copy(update={"path": str(file)}).read()
        return [f._replace(source=read(f.source), file=f.source) for f in files]

    def reading(self) -> dict[str, Any]:
        """Arguments of `read_mask`."""
        plane = self.plane if self.channel is None else None
        return {"kind": self.kind, "background": self.background, "plane": plane}

    def options(self) -> dict[str, Any]:
        """Arguments of `infer_tensions`."""
        size = None if self.pixel_size is None else (self.pixel_size[0], self.pixel_size[1])
        return self.reading() | {
            "gap_width": self.gap_width,
            "holes": self.holes,
            "pixel_size": size,
            "height": self.height,
            "plane_distance": self.plane_distance,
            "unknown_height": self.unknown_height,
        }


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
    tables: Literal["csv", "parquet"] = "csv"
    """Format of the tables of all masks; Parquet needs the extra [cluster]."""
    maps: int = Field(default=500, ge=0)
    """Largest number of masks with a map, the first ones, which are the frames of the animation."""


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Infer tensions and pressures.

    **Returns:** the metrics: of one mask numbers of determined tensions and pressures, their spread and
    uncertainty, noise of the image and distance from balance, for a synthetic cluster also the errors; of
    several masks numbers of masks, cells and tensions.
    """
    options: dict[str, Any] = config.image.options()
    reading, truth = config.image.reading(), None
    if config.image.path == SYNTHETIC:
        truth, labels = draw_cluster(config)
        frames = [MaskFrame(0, labels)]
        options, reading = options | {"kind": "labels"}, {"kind": "labels"}
    else:
        frames = config.image.frames()
    masks = infer_tensions_of_masks(
        frames,
        **options,
        noise=config.noise,
        prior=config.prior,
        cache=folder.parts,
        executor=folder.executor,
        progress=progress,
    )
    masks.write(folder.path, format=config.tables)
    for name, result in masks.results.items():
        for warning in result.warnings:
            folder.warn(warning, str(name) if len(frames) > 1 else None)
    for name, error in masks.failures.items():
        folder.warn(f"no result: {error.removesuffix('.')}", str(name))
    if len(frames) > 1:
        folder.print_step("maps")
        chosen = [frame for frame in frames if frame.name in masks.results][: config.maps]
        if len(chosen) < len(masks.results):
            folder.warn(f"maps of {len(chosen)} of {len(masks.results)} masks (key maps)")
        maps = draw_maps(folder, chosen, masks, reading)
        if chosen:
            plotting.animate_figures(maps, folder.path / "tensions.gif", fps=4)
        return measure_masks(masks)
    (result,) = masks.results.values()
    folder.save_tissue("seen", result.tissue)
    cells, edges = result.cell_table(), result.edge_table()
    write_geojson(
        folder.path / "cells.geojson",
        result.tissue,
        cells={name: cells[name] for name in ("label", "pressure", "pressure_deviation")},
        edges={name: edges[name] for name in ("tension", "tension_deviation", "determined")},
    )
    figure = plotting.plot_tensions(result, frames[0].mask(**reading))
    folder.save_figure("tensions", figure)
    if result.curved is not None:
        figure = Figure(figsize=(5, 4))
        axes = figure.add_subplot(projection="3d")
        plotting.plot_surface(result.curved.tissue, result.curved.areas, ax=axes, label="area")
        folder.save_figure("surface", figure)
    metrics = measure(result)
    if truth is not None:
        tables = compare(result, *truth)
        for name, table in tables.items():
            folder.save_table(f"true_{name}s", table)
        if all(table[name].size for name, table in tables.items()):
            folder.save_figure("recovery", plot_recovery(tables))
            metrics |= measure_errors(tables)
    return metrics


def draw_maps(
    folder: runs.RunFolder,
    frames: list[MaskFrame],
    masks: TensionsOfMasks,
    reading: dict[str, Any],
) -> Iterator[Figure]:
    """A map of each mask, all with the same limits of the colours."""
    extremes: dict[str, list[float]] = {"": [], "edge_": []}
    for result in map(masks.results.__getitem__, (frame.name for frame in frames)):
        extremes[""] += result.pressures[result.pressures_determined].tolist()
        extremes["edge_"] += result.tensions[result.determined].tolist()
    limits = {f"{x}vmin": min(values) for x, values in extremes.items() if values}
    limits |= {f"{x}vmax": max(values) for x, values in extremes.items() if values}
    for frame in frames:
        figure = plotting.plot_tensions(masks.results[frame.name], frame.mask(**reading), **limits)
        figure.axes[0].set_title(str(frame.name))
        folder.save_figure(str(frame.name).replace("/", "_"), figure)
        yield figure


def draw_cluster(config: Config) -> tuple[tuple[Any, Any], np.ndarray]:
    """The energy of a cluster and the cluster at equilibrium, and its label image."""
    options = config.cluster
    shape_key, tension_key, area_key = jax.random.split(jax.random.key(config.seed), 3)
    cluster = free_voronoi(options.n_cells, key=shape_key, lloyd_steps=3, inner_arcs=True)
    # Three tensions between 0.5 and 1.5 can balance at any junction.
    limit = 0.5 / max(options.deviation, 1e-9)
    noise = jax.random.truncated_normal(tension_key, -limit, limit, (cluster.n_edges,))
    tension = 1 + options.deviation * noise
    areas = jax.random.uniform(area_key, (options.n_cells,), minval=0.9, maxval=1.3)
    bounds: dict[str, Any] = {"stiffness": options.stiffness, "low": 0.05, "high": 4.0}
    energy = foam_energy(tension / jnp.mean(tension), areas, **bounds)
    relaxed = runs.RelaxationSection().build()(cluster, energy).tissue
    return (energy, relaxed), inference.label_image(relaxed, options.pixels)


def compare(result: InferredTensions, energy: Any, tissue: Any) -> dict[str, dict[str, np.ndarray]]:
    """Tables of the inferred tensions and pressures with true values, in the units of the inferred ones."""
    area, line = energy.terms
    edges = result.edge_table()
    # A label is the index of the true cell plus 1.
    number = np.append(np.arange(1, tissue.n_cells + 1), 0)
    true_pairs = np.sort(number[np.asarray(tissue.topology.edge_cells)], axis=1)
    pairs = np.sort(np.stack([edges["left_label"], edges["right_label"]], axis=1), axis=1)
    by_pair: dict[tuple[int, ...], list[float]] = {}
    for pair, value in zip(true_pairs.tolist(), np.asarray(line.tension), strict=True):
        by_pair.setdefault(tuple(pair), []).append(float(value))
    # The two edges of a pair of cells that share two have the same labels.
    values = [by_pair.get(tuple(pair), []) for pair in pairs.tolist()]
    tension = np.array([v[0] if len(v) == 1 else np.nan for v in values])
    compared = result.determined & np.isfinite(tension)
    # The unit is the mean of all tensions that have an equation.
    unit = np.isfinite(result.tensions) & np.isfinite(tension)
    mean = tension[unit].mean() if unit.any() else 1.0
    sizes = [np.mean(np.asarray(each.areas)) for each in (tissue, result.tissue)]
    pressure = np.asarray(area.pressures(tissue))[np.asarray(result.labels) - 1]
    pressure = pressure / mean * np.sqrt(sizes[0] / sizes[1])
    determined = result.pressures_determined
    pressure = pressure - np.nanmean(np.where(np.isnan(result.pressures), np.nan, pressure))
    return {
        "tension": {
            "edge": np.flatnonzero(compared),
            "tension": result.tensions[compared],
            "tension_deviation": result.tension_deviations[compared],
            "true_tension": tension[compared] / mean,
        },
        "pressure": {
            "cell": np.flatnonzero(determined),
            "pressure": result.pressures[determined],
            "pressure_deviation": result.pressure_deviations[determined],
            "true_pressure": pressure[determined],
        },
    }


@plotting.house_style()
def plot_recovery(tables: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Inferred against true tensions and pressures."""
    figure, (axes,) = plotting.new_figure(1, 2, width=2.9, height=2.7)
    for ax, (name, table) in zip(axes, tables.items(), strict=True):
        options: Any = {"deviation": table[f"{name}_deviation"], "ax": ax, "name": name}
        plotting.plot_recovery(table[f"true_{name}"], table[name], **options)
    return figure


def measure_errors(tables: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    """The metrics of the errors of a synthetic cluster."""
    metrics: dict[str, Any] = {}
    for name, table in tables.items():
        error = table[name] - table[f"true_{name}"]
        metrics[f"pearson_{name}"] = inference.pearson(table[f"true_{name}"], table[name])
        metrics[f"rms_error_{name}"] = np.sqrt(np.mean(error**2))
        within = np.abs(error) < 2 * table[f"{name}_deviation"]
        metrics[f"{name}_within_two_deviations"] = np.mean(within)
    return metrics


def measure(result: InferredTensions) -> dict[str, Any]:
    """The metrics of one mask."""
    pixel = float(np.sqrt(np.prod(pixel_sides(result.pixel_size))))
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
        "edges": result.edges,
        "warnings": list(result.warnings),
        "tension_reasons": result.reason_counts,
        "area_error_max": float(np.max(np.abs(result.area_errors[is_cell]))),
        "stress_anisotropy": result.mean_stress.anisotropy,
        "stress_anisotropy_deviation": result.mean_stress.anisotropy_deviation,
        "stress_direction_degrees": np.degrees(result.mean_stress.direction),
        "stress_direction_deviation_degrees": np.degrees(result.mean_stress.direction_deviation),
    }
    metrics |= {f"error_{name}": value for name, value in result.errors.items()}
    if result.mask_report is not None:
        summary = result.mask_report.summary()
        metrics |= {f"mask_{name}": value for name, value in summary.items()}
    pressures = result.pressures, result.pressure_deviations, result.pressures_determined
    for name, values, deviations, determined in (
        ("tension", result.tensions, result.tension_deviations, result.determined),
        ("pressure", *pressures),
    ):
        if determined.any():
            inferred = values[determined]
            metrics[f"{name}_min"], metrics[f"{name}_max"] = inferred.min(), inferred.max()
            metrics[f"{name}_std"] = inferred.std()
            metrics[f"{name}_deviation_median"] = np.median(deviations[determined])
    return metrics


def measure_masks(masks: TensionsOfMasks) -> dict[str, Any]:
    """The metrics of several masks."""
    frames = masks.frame_table()
    return {
        "n_masks": len(frames["frame"]),
        "n_failed": len(masks.failures),
        "failed": {str(name): error for name, error in masks.failures.items()},
        "n_cells": int(frames["n_cells"].sum()),
        "n_tensions_determined": int(frames["n_determined"].sum()),
    }
