"""Distinguish a stiff from a fluid epithelium by the shape factors inferred from micrographs (Figure 3g).

Tissues with shape factors drawn around two means are relaxed and imaged by a synthetic microscope: blurred,
unevenly lit, with faint membranes, at several signal-to-noise ratios, cut at the border of the image. Each
image is segmented and fitted as in `infer_from_microscopy`. The complete cells are compared with the truth,
and one condition with the other.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy.stats import mannwhitneyu

import vertax as vx
from experiments._replicates import plot_boxes, same_limits
from vertax import plotting, runs
from vertax.inference import pearson
from vertax.jobs import infer_from_microscopy as microscopy

COLOURS = {"stiff": plotting.SERIES[0], "fluid": plotting.SERIES[1]}


class Views(runs.MicroscopeSection):
    """The microscope; intensities are relative to the brightest membrane."""

    snr: list[float] = Field(default=[20.0, 6.0, 3.0], min_length=1)
    """Signal-to-noise ratios: brightest membrane over standard deviation of the noise."""


class Config(runs.ExperimentConfig):
    """Configuration of this experiment."""

    stiff: runs.ShapeFactors = runs.ShapeFactors(mean=3.65, deviation=0.08)
    """Shape factors of one condition."""
    fluid: runs.ShapeFactors = runs.ShapeFactors(mean=3.85, deviation=0.08)
    """Shape factors of the other one."""
    images: int = Field(default=3, ge=1)
    """Images of each condition; all signal-to-noise ratios have the same tissues."""
    tissue: runs.TissueSection = runs.TissueSection(n_cells=64, lloyd_steps=1)
    """The tissue of an image."""
    microscope: Views = Views(pixels=288, background=0.15, vignetting=0.4, faint=0.05)
    """The microscope."""
    preparation: microscopy.Preparation = microscopy.Preparation()
    """Preparation of the images."""
    segmentation: microscopy.Segmenter = microscopy.Segmenter()
    """Segmentation of the cells."""
    model: microscopy.MicrographModel = microscopy.MicrographModel(border="pinned", rest_areas="equal")
    """Energy and first guess, the same for both conditions; the scale of the images is given."""
    fit: runs.Fitting = runs.Fitting(learning_rate=2e-2, epochs=120)
    """Fit of the parameters."""
    prior: float = Field(default=0.3, gt=0)
    """Standard deviation of a parameter without the image."""
    relaxation: runs.RelaxationSection = runs.RelaxationSection(tolerance=1e-7)
    """Relaxation of the tissues."""


class Image(NamedTuple):
    """One image: true and inferred shape factors of its complete cells, with standard deviations."""

    condition: str
    number: int
    snr: float
    true: np.ndarray
    inferred: np.ndarray
    deviation: np.ndarray
    correlation: float
    num_undetermined: int


def run(config: Config, folder: runs.RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """By signal-to-noise ratio: correlation, error, coverage, means of both conditions, Mann-Whitney test."""
    images: list[Image] = []
    failures: list[str] = []
    pictures: dict[str, Any] = {}
    key = jax.random.key(config.seed)
    cases = [(s, kind, n) for s in config.microscope.snr for kind in COLOURS for n in range(config.images)]
    for snr, kind, number in cases:
        draw, noise = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, number), kind == "fluid"))
        tissue, truth = make_tissue(config, getattr(config, kind), draw)
        noise = jax.random.fold_in(noise, config.microscope.snr.index(snr))
        pixels = config.microscope.build(1 / snr)(tissue, key=noise)
        try:
            micrograph, fit = infer(config, pixels, folder, f"{kind} {number} SNR {snr:g}", progress)
        except (ValueError, vx.FitError) as error:
            failures.append(f"{kind} {number}, SNR {snr:g}: {error}")
            continue
        uncertainty: Any = micrograph.uncertainty(fit, prior=config.prior)
        cells, true_cells = match_cells(config, micrograph, tissue)
        true, inferred, deviation = (
            np.asarray(energy.target_shape_factor)[chosen]
            for energy, chosen in (
                (truth, true_cells),
                (fit.energy, cells),
                (uncertainty.deviation, cells),
            )
        )
        undetermined = int(np.sum(np.asarray(uncertainty.deviations) > 0.9 * config.prior))
        correlation = micrograph.correlation(fit.tissue)
        images.append(Image(kind, number, snr, true, inferred, deviation, correlation, undetermined))
        folder.save_table("cells", cell_table(images))
        if number == 0:
            pictures[f"{kind}, SNR {snr:g}"] = (pixels, micrograph.segmentation, fit)
    if not images:
        raise ValueError(f"No image could be read: {'; '.join(failures)}")
    folder.save_figure("conditions", plot_conditions(images))
    folder.save_figure("images", plot_images(pictures))
    if failures:
        folder.warn(f"{len(failures)} images could not be read: see `failures` in the metrics")
    metrics: dict[str, Any] = {f"SNR {s:g}": measure(config, images, s) for s in config.microscope.snr}
    return metrics | {"failures": failures}


def make_tissue(config: Config, factors: runs.ShapeFactors, key: Any) -> tuple[vx.Tissue, Any]:
    """A tissue and its energy; a floppy tissue may not converge, and its image is as valid."""
    keys, n = jax.random.split(key), config.tissue.n_cells
    p0 = factors.mean + factors.deviation * jax.random.normal(keys[0], (n,))
    energy = vx.energies.ShapeFactorEnergy(p0)
    first = vx.initialise.periodic_voronoi(n, key=keys[1], lloyd_steps=config.tissue.lloyd_steps)
    return config.relaxation.build()(first, energy, throw=False).tissue, energy


def infer(config: Config, pixels: Any, folder: runs.RunFolder, name: str, progress: bool) -> Any:
    """The micrograph of an image and its fit."""
    model = config.model
    if model.pixel_size is None:
        side = float(np.sqrt(config.tissue.n_cells))
        model = model.model_copy(update={"pixel_size": side / config.microscope.pixels})
    settings = config.preparation, config.segmentation, model, config.relaxation
    micrograph = microscopy.read_micrograph(pixels, *settings)
    options: Any = {"partial": True, "progress": progress}
    optimiser, epochs = config.fit.build(), config.fit.epochs
    return micrograph, folder.fit(name, micrograph.problem, optimiser, epochs, **options)


def match_cells(config: Config, micrograph: Any, tissue: vx.Tissue) -> tuple[np.ndarray, np.ndarray]:
    """Complete cells of the segmented mesh, and the true cells with the nearest centroids."""
    cells, segmentation = np.flatnonzero(micrograph.complete), micrograph.segmentation
    pixel = float(np.sqrt(tissue.n_cells)) / config.microscope.pixels
    scale = pixel / vx.io.pixel_sides(segmentation.pixel_size)
    centroids = np.asarray(segmentation.tissue.centroids)[cells] * scale
    vectors = tissue.boundary.shortest(jnp.asarray(centroids)[:, None] - tissue.centroids[None])
    distance = np.asarray(jnp.linalg.norm(vectors, axis=-1))
    nearest, close = distance.argmin(axis=1), distance.min(axis=1) < 0.25
    # A wrongly merged or split cell has no counterpart.
    single = np.bincount(nearest, minlength=tissue.n_cells)[nearest] == 1
    return cells[close & single], nearest[close & single]


def measure(config: Config, images: list[Image], snr: float) -> dict[str, Any]:
    """The metrics of one signal-to-noise ratio."""
    group = [image for image in images if image.snr == snr]
    join = lambda name, group: np.concatenate([getattr(i, name) for i in group] or [np.zeros(0)])
    by_kind = {kind: [i for i in group if i.condition == kind] for kind in COLOURS}
    cells = {kind: join("inferred", each) for kind, each in by_kind.items()}
    sizes = {"images": len(group), "images_wanted": 2 * config.images, "cells": sum(map(len, cells.values()))}
    if min(map(len, cells.values())) < 2:
        return sizes
    true, inferred, deviation = (join(name, group) for name in ("true", "inferred", "deviation"))
    test = mannwhitneyu(cells["fluid"], cells["stiff"], alternative="greater")
    within = {f"pearson_within_{k}": pearson(join("true", by_kind[k]), cells[k]) for k in cells}
    return sizes | {
        "pearson": pearson(true, inferred),
        **within,
        "error_rms": np.sqrt(np.mean((inferred - true) ** 2)),
        "error_mean": np.mean(inferred - true),
        "deviation_median": np.median(deviation),
        "within_two_deviations": np.mean(np.abs(inferred - true) < 2 * deviation),
        "undetermined_combinations": np.mean([i.num_undetermined for i in group]),
        "image_correlation": np.mean([i.correlation for i in group]),
        "stiff_mean": cells["stiff"].mean(),
        "fluid_mean": cells["fluid"].mean(),
        "fluid_is_larger": test.statistic / (len(cells["fluid"]) * len(cells["stiff"])),
        "p_value": test.pvalue,
    }


def cell_table(images: list[Image]) -> dict[str, Any]:
    """One row per cell of all images."""
    sizes = [len(image.true) for image in images]
    names = {"condition": "condition", "image": "number", "snr": "snr"}
    table = {k: np.repeat([getattr(i, name) for i in images], sizes) for k, name in names.items()}
    columns = ("true", "inferred", "deviation")
    return table | {name: np.concatenate([getattr(i, name) for i in images]) for name in columns}


@plotting.house_style()
def plot_conditions(images: list[Any]) -> Any:
    """Inferred against true shape factors, and both conditions, at each signal-to-noise ratio."""
    ratios = list(dict.fromkeys(image.snr for image in images))
    figure, axes = plotting.new_figure(2, len(ratios))
    for (scatter, box), snr in zip(axes.T, ratios, strict=True):
        cells = {}
        for kind, colour in COLOURS.items():
            group = [image for image in images if (image.snr, image.condition) == (snr, kind)]
            if not group:
                continue
            names = ("true", "inferred", "deviation")
            true, inferred, deviation = (np.concatenate([getattr(i, n) for i in group]) for n in names)
            options: dict[str, Any] = {"deviation": deviation, "name": "$p_0$", "colour": colour}
            plotting.plot_recovery(true, inferred, ax=scatter, label=kind, **options)
            cells[kind] = inferred
        scatter.set_title(f"SNR {snr:g}")
        plot_boxes(cells, box, colours=COLOURS)
        box.set_ylabel("inferred $p_0$")
    same_limits(axes[0])
    same_limits(axes[1], x=False)
    axes[0, 0].legend(loc="upper left")
    return figure


@plotting.house_style()
def plot_images(pictures: dict[str, tuple[np.ndarray, Any, Any]]) -> Any:
    """The first image of each kind, alone and under the fitted mesh."""
    figure, axes = plotting.new_figure(2, 2 * max(1, (len(pictures) + 1) // 2), width=2.3, height=2.45)
    for ax in axes.ravel():
        ax.set_axis_off()
    for k, (title, (pixels, segmentation, fit)) in enumerate(pictures.items()):
        raw, fitted = axes[k % 2, 2 * (k // 2) : 2 * (k // 2) + 2]
        size: dict[str, Any] = {"pixel_size": segmentation.pixel_size}
        plotting.plot_image(pixels, ax=raw, **size)
        vx.plot_tissue(fit.tissue, ax=fitted, image=pixels, linewidth=0.9, **size)
        plotting.scale_bar(raw, "pixels", unit_length=vx.io.pixel_sides(segmentation.pixel_size)[0])
        raw.set_title(title)
        fitted.set_title("fitted mesh")
    return figure
