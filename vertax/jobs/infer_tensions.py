"""Infer relative tensions and pressures of a cluster from its segmented image.

The image has outlines of cells, or labels. Each edge becomes an arc; tensions and pressures balance at the
junctions of three cells and along arcs. A shape determines them up to one factor: they are relative to the
mean tension. Without an image a cluster of given tensions is drawn and segmented, and the results are
compared. A folder, a pattern such as masks/*.tif or a movie gives one table of all masks.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from pydantic import Field, model_validator

from vertax import inference, plotting, runs
from vertax.initialise import free_voronoi
from vertax.io import from_edge_table, pixel_sides, write_geojson

SYNTHETIC = "synthetic"
# Without the palest end, which looks like no colour.
PRESSURES = ListedColormap(colormaps["Blues"](np.linspace(0.15, 1, 256)), "pressures")
TENSION = r"tension $\gamma / \bar\gamma$"
PRESSURE = r"pressure $(p - \bar p)\,\sqrt{\bar A}\,/\,\bar\gamma$"


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
    """Height and width of a pixel that is not square; left out, from the resolution of a TIFF file."""

    @model_validator(mode="before")
    @classmethod
    def _path_alone(cls, value: Any) -> Any:
        return {"path": value} if isinstance(value, str) else value

    def frames(self) -> list[inference.MaskFrame]:
        """The masks of a folder, a pattern or a movie; none for a single image."""
        if self.path in (None, SYNTHETIC) or self.channel is not None:
            return []
        frames = inference.find_masks(self.path, plane=self.plane)
        return [] if frames[0].source == Path(self.path) else frames

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

    def options(self) -> dict[str, Any]:
        """Arguments of `infer_tensions` beside those of `read_mask`."""
        size = None if self.pixel_size is None else (self.pixel_size[0], self.pixel_size[1])
        return {"gap_width": self.gap_width, "holes": self.holes, "pixel_size": size}


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
    if frames := config.image.frames():
        return run_frames(config, frames, folder, progress)
    truth: Any = None
    if config.image.path != SYNTHETIC:
        frame = inference.MaskFrame(0, config.image.source())
        reading, labels = config.image.reading(), config.image.labels()
    else:
        truth, labels = draw_cluster(config)
        frame, reading = inference.MaskFrame(0, labels), {"kind": "labels"}
    result = infer(config, frame, reading)
    for warning in result.warnings:
        folder.warn(warning)
    folder.save_tissue("seen", result.tissue)
    content = inferred(result)
    edges, cells = content.edges, content.cells
    if truth is not None:
        add_truth(result, truth[0], truth[1], edges, cells)
    tables = {"cells": cells, "edges": edges, "changes": content.changes}
    save_tables(folder, config, {name: table for name, table in tables.items() if table})
    write_geojson(
        folder.path / "cells.geojson",
        result.tissue,
        cells={name: cells[name] for name in ("label", "pressure", "pressure_deviation")},
        edges={name: edges[name] for name in ("tension", "tension_deviation", "determined")},
    )
    folder.save_figure("tensions", plot_foam(plotting.label_colours(labels), content))
    if truth is not None and result.determined.any():
        folder.save_figure("recovery", plot_recovery(edges, cells))
    return measure(result, edges, cells)


def infer(
    config: Config, frame: inference.MaskFrame, reading: dict[str, Any]
) -> inference.InferredTensions:
    """The tensions of one mask."""
    options = reading | config.image.options() | {"prior": config.prior}
    result = frame.infer(**options)
    if config.noise is None or result.pixel_size is None:
        return result
    return frame.infer(
        **options, noise=config.noise * np.sqrt(np.prod(pixel_sides(result.pixel_size)))
    )


class Inferred(NamedTuple):
    """The tables of one mask, from which its map is drawn."""

    edges: dict[str, Any]
    cells: dict[str, Any]
    changes: dict[str, Any]
    """The report on the mask; no rows without a mask."""
    pixel_size: tuple[float, float]
    """Height and width."""


def inferred(result: inference.InferredTensions) -> Inferred:
    """The tables of one mask."""
    report = result.mask_report
    changes = {} if report is None else report.change_table()
    width, height = pixel_sides(result.pixel_size or 1.0).tolist()
    return Inferred(result.edge_table(), result.cell_table(), changes, (height, width))


def save_tables(folder: runs.RunFolder, config: Config, tables: dict[str, dict[str, Any]]) -> None:
    """Write tables, and the table of the units and meanings of their columns."""
    columns = inference.column_descriptions(tables, inference.length_unit(config.image.pixel_size))
    for name, table in (tables | {"columns": columns}).items():
        folder.save_table(name, table)


def run_frames(
    config: Config, frames: list[inference.MaskFrame], folder: runs.RunFolder, progress: bool
) -> dict[str, Any]:
    """Infer the tensions of many masks; a resumed run keeps those that are done."""
    reading, failures = config.image.reading(), {}

    def compute(frame: inference.MaskFrame) -> dict[str, np.ndarray]:
        result = infer(config, frame, reading)
        content, summary = inferred(result), inference.frame_summary(result)
        tables = {"edges": content.edges, "cells": content.cells, "changes": content.changes}
        arrays = {
            f"{t}.{name}": np.asarray(c) for t, table in tables.items() for name, c in table.items()
        }
        return arrays | {"summary": np.asarray(json.dumps(summary))}

    def one(index: int) -> dict[str, np.ndarray] | None:
        frame = frames[index]
        try:
            return folder.part(f"mask {frame.name}", lambda: compute(frame))
        except Exception as error:
            failures[frame.name] = str(error)
            return None

    parts = folder.map_in_threads(one, len(frames), progress=progress, unit="mask")
    arrays = {frame.name: part for frame, part in zip(frames, parts, strict=True) if part}
    failures = {frame.name: failures[frame.name] for frame in frames if frame.name in failures}
    inference.check_any(arrays, failures)
    summaries = {name: json.loads(str(part.pop("summary"))) for name, part in arrays.items()}
    tables: dict[str, Any] = {
        kind: inference.join_frames({n: table_of(kind, part) for n, part in arrays.items()})
        for kind in ("cells", "edges", "changes")
    }
    names = [*arrays, *failures]
    tables["frames"] = inference.frame_table(names, list(summaries.values()), failures)
    save_tables(folder, config, tables)
    folder.save_table("failed", {"frame": list(failures), "error": list(failures.values())})
    for name, summary in summaries.items():
        for text in filter(None, summary["warnings"].split(" | ")):
            folder.warn(text, str(name))
    draw_frames(folder, frames, arrays, summaries, reading)
    return {
        "n_masks": len(frames),
        "n_failed": len(failures),
        "failed": {str(name): error for name, error in failures.items()},
        "n_cells": sum(summary["n_cells"] for summary in summaries.values()),
        "n_tensions_determined": sum(summary["n_determined"] for summary in summaries.values()),
    }


def table_of(kind: str, part: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A table of the stored arrays of a mask."""
    prefix = f"{kind}."
    return {name.removeprefix(prefix): x for name, x in part.items() if name.startswith(prefix)}


def draw_frames(
    folder: runs.RunFolder,
    frames: list[inference.MaskFrame],
    arrays: dict[str | int, dict[str, np.ndarray]],
    summaries: dict[str | int, dict[str, Any]],
    reading: dict[str, Any],
) -> None:
    """A map of each mask, all with the same limits of the colours, and an animation of them."""
    folder.print_step("maps")
    done = [frame for frame in frames if frame.name in arrays]
    content = {}
    for name, part in arrays.items():
        tables = [table_of(kind, part) for kind in ("edges", "cells", "changes")]
        size = summaries[name]["pixel_height"], summaries[name]["pixel_width"]
        content[name] = Inferred(tables[0], tables[1], tables[2], size)
    limits = colour_limits(list(content.values()))

    def maps() -> Iterator[Figure]:
        for frame in done:
            image = plotting.label_colours(frame.mask(**reading))
            figure = plot_foam(image, content[frame.name], limits, title=str(frame.name))
            folder.save_figure(f"{frame.name}", figure)
            yield figure

    plotting.animate_figures(maps(), folder.path / "tensions.gif", fps=4)


def colour_limits(content: list[Inferred]) -> dict[str, float]:
    """Limits of the colours of all masks together: of pressures and of tensions."""
    limits: dict[str, float] = {}
    for prefix, tables, key in (
        ("", [each.cells for each in content], "pressure"),
        ("edge_", [each.edges for each in content], "tension"),
    ):
        values = np.concatenate([table[key][table["determined"]] for table in tables])
        if values.size:
            low, high = np.quantile(values, (0.005, 0.995))
            limits |= {f"{prefix}vmin": float(low), f"{prefix}vmax": float(high)}
    return limits


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
        "edges": result.edges,
        "warnings": list(result.warnings),
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
def plot_foam(
    image: np.ndarray,
    content: Inferred,
    limits: dict[str, float] | None = None,
    *,
    title: str = "arcs over the image",
) -> Figure:
    """The image with the arcs, and a map of tensions and pressures; grey where they are not determined.

    On the image the sides of holes are dashed, contacts that the mask does not show are dotted, and a ring
    marks each place where the mask was changed.
    """
    rows, columns = image.shape[:2]
    height = max(3.4 * rows / columns + 0.5, 2.4)
    tissue = from_edge_table(content.edges)
    figure, ((left, right),) = plotting.new_figure(1, 2, width=3.6, height=height, room=1.2)
    plotting.plot_tissue(tissue, ax=left, image=image, pixel_size=content.pixel_size)
    left.set_title(title)
    plotting.scale_bar(left, "pixels", unit_length=content.pixel_size[1])
    if "shown" in content.edges:
        draw_report(left, tissue, content)
    pressures = np.where(content.cells["determined"], content.cells["pressure"], np.nan)
    tensions = np.where(content.edges["determined"], content.edges["tension"], np.nan)
    style: dict[str, Any] = {"cmap": PRESSURES, "label": PRESSURE, "edge_label": TENSION} | (
        limits or {}
    )
    plotting.plot_tissue(tissue, pressures, tensions, ax=right, **style)
    # The y axis points down, as in the image.
    right.set(xlim=left.get_xlim(), ylim=left.get_ylim())
    right.set_title("tensions and pressures")
    return figure


def draw_report(ax: Any, tissue: Any, content: Inferred) -> None:
    """Mark holes, contacts that the mask does not show, and places where the mask was changed."""
    height, width = content.pixel_size
    points = np.asarray(tissue.edge_points(jnp.linspace(0.0, 1.0, 13)), float)
    edge_cells = np.stack([content.edges["left_cell"], content.edges["right_cell"]], axis=1)
    hole = np.append(content.cells["hole"], False)[edge_cells].any(axis=1)
    hidden = content.edges["contact_closed"] & ~hole & np.all(edge_cells >= 0, axis=1)
    for which, style in ((hidden, ":"), (hole, "--")):
        if which.any():
            lines = LineCollection(list(points[which]), colors="w", linestyles=style, lw=1.5)
            ax.add_collection(lines)
    least = 0.01 * np.median(content.cells["pixels"])
    changes = (content.changes[name] for name in ("row", "column", "pixels"))
    for row, column, pixels in zip(*changes, strict=True):
        area = max(pixels, least) * height * width
        radius = max(3.0 * min(height, width), np.sqrt(area / np.pi))
        ax.add_patch(Circle((width * column, height * row), radius, fill=False, ec="r", lw=1.0))


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
