"""Are two conditions told apart by the shape factors that their images show?

Synthetic microscopy of a stiff and of a fluid-like epithelium: hidden shape factors are drawn around two
means, tissues relaxed, and seen as a microscope might (blurred, unevenly lit, with faint stretches of
membrane, at several signal-to-noise ratios, cut off at the border of the image). Each image then goes
the whole way from pixels to shape factors, as a real one does in `infer_from_microscopy`, and the cells
that lie whole in it are compared with the truth, and one condition with the other (paper, Figure 3g).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from pydantic import Field
from scipy.stats import mannwhitneyu

from vertax._base.pixels import pixel_sides
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Fit, FitError
from vertax.inference import Micrograph, pearson
from vertax.initialise import periodic_voronoi
from vertax.mesh import Tissue
from vertax.runs import (
    ExperimentConfig,
    Fitting,
    MicrographModel,
    Microscope,
    Preparation,
    Relaxation,
    RunFolder,
    Segmenter,
    ShapeFactors,
    TissueSection,
    read_micrograph,
)

from . import figures


class Views(Microscope):
    """How the tissues are seen; intensities are relative to the brightest membrane."""

    snr: list[float] = Field(default=[20.0, 6.0, 3.0], min_length=1)
    """Signal-to-noise ratios: brightest membrane over standard deviation of the noise."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    stiff: ShapeFactors = ShapeFactors(mean=3.65, deviation=0.08)
    """Shape factors of the one condition."""
    fluid: ShapeFactors = ShapeFactors(mean=3.85, deviation=0.08)
    """Shape factors of the other."""
    images: int = Field(default=3, ge=1)
    """Images of each condition; the same tissues are seen at all signal-to-noise ratios."""
    tissue: TissueSection = TissueSection(n_cells=64, lloyd_steps=1)
    """The tissue of an image."""
    microscope: Views = Views(pixels=288, background=0.15, vignetting=0.4, faint=0.05)
    """How it is seen."""
    preparation: Preparation = Preparation()
    """How images are prepared."""
    segmentation: Segmenter = Segmenter()
    """How cells are found."""
    model: MicrographModel = MicrographModel(border="pinned", rest_areas="equal")
    """The energy and the first guess, the same for both conditions. The scale of the images is known."""
    fit: Fitting = Fitting(learning_rate=2e-2, epochs=120)
    """How the parameters are fitted."""
    prior: float = Field(default=0.3, gt=0)
    """What is known of a parameter without the image: its standard deviation."""
    relaxation: Relaxation = Relaxation(tolerance=1e-7)
    """How tissues are relaxed."""


class _Image(NamedTuple):
    """One image and what was found in it; the cells are those that lie whole in it."""

    condition: str
    number: int
    snr: float
    true: Float[np.ndarray, " cells"]
    inferred: Float[np.ndarray, " cells"]
    deviation: Float[np.ndarray, " cells"]
    correlation: float
    num_undetermined: int


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show progress bars (only on a terminal).

    **Returns:** the metrics by signal-to-noise ratio: correlation and error of the inferred shape
    factors, how often the truth lies within two standard deviations, the means of both conditions, and
    the Mann-Whitney test between them (probability that a cell of the fluid condition has the larger
    shape factor, and p-value). `failures` says of images that could not be read why.

    **Raises:**

    - `ValueError` if no image could be read.
    """
    found: list[_Image] = []
    failures: list[str] = []
    pictures: dict[str, Any] = {}
    key = jax.random.key(config.seed)
    for snr_index, snr in enumerate(config.microscope.snr):
        for kind, factors in (("stiff", config.stiff), ("fluid", config.fluid)):
            for number in range(config.images):
                own = jax.random.fold_in(jax.random.fold_in(key, number), kind == "fluid")
                draw, noise = jax.random.split(own)
                tissue, truth = _tissue(config, factors, draw)
                noise = jax.random.fold_in(noise, snr_index)
                pixels = config.microscope.build(1 / snr)(tissue, key=noise)
                name = f"{kind} {number} SNR {snr:g}"
                result = _infer(config, pixels, folder, name, progress)
                if isinstance(result, str):
                    failures.append(f"{kind} {number}, SNR {snr:g}: {result}")
                    continue
                micrograph, outcome, deviation, n_undetermined = result
                cells = _counterparts(config, micrograph, tissue)
                image = _Image(
                    kind,
                    number,
                    snr,
                    np.asarray(truth.target_shape_factor)[cells[:, 1]],
                    np.asarray(outcome.energy.target_shape_factor)[cells[:, 0]],
                    deviation[cells[:, 0]],
                    micrograph.correlation(outcome.tissue),
                    n_undetermined,
                )
                found.append(image)
                _save_table(found, folder)
                if number == 0:
                    pictures[f"{kind}, SNR {snr:g}"] = (
                        pixels,
                        micrograph.segmentation,
                        outcome,
                    )
    if not found:
        raise ValueError(f"No image could be read: {'; '.join(failures)}")
    folder.save_figure("conditions", figures.conditions(found))
    folder.save_figure("images", figures.images(pictures))
    metrics: dict[str, Any] = {
        f"SNR {snr:g}": _metrics(config, found, snr) for snr in config.microscope.snr
    }
    if failures:
        folder.warn(f"{len(failures)} images could not be read: see `failures` in the metrics")
    return metrics | {"failures": failures}


def _tissue(
    config: Config, factors: ShapeFactors, key: PRNGKeyArray
) -> tuple[Tissue, ShapeFactorEnergy]:
    keys = jax.random.split(key)
    n = config.tissue.n_cells
    p0 = factors.mean + factors.deviation * jax.random.normal(keys[0], (n,))
    energy = ShapeFactorEnergy(p0)
    first = periodic_voronoi(n, key=keys[1], lloyd_steps=config.tissue.lloyd_steps)
    # Floppy tissues come to rest anywhere: converged or not, this is what the microscope sees.
    return config.relaxation.build()(first, energy, throw=False).tissue, energy


def _infer(
    config: Config,
    pixels: Float[np.ndarray, "rows columns"],
    folder: RunFolder,
    name: str,
    progress: bool,
) -> tuple[Micrograph, Fit, Float[np.ndarray, " cells"], int] | str:
    """From pixels to shape factors and their uncertainty; or what was in the way."""
    model = config.model
    if model.pixel_size is None:
        side = float(np.sqrt(config.tissue.n_cells))
        model = model.model_copy(update={"pixel_size": side / config.microscope.pixels})
    optimiser, epochs = config.fit.build(), config.fit.epochs
    try:
        micrograph = read_micrograph(
            pixels, config.preparation, config.segmentation, model, config.relaxation
        )
        outcome = folder.fit(
            name, micrograph.problem, optimiser, epochs, partial=True, progress=progress
        )
    except (ValueError, FitError) as error:
        return str(error)
    known = micrograph.uncertainty(outcome, prior=config.prior)
    deviation = np.asarray(known.deviation.target_shape_factor)  # pyright: ignore
    undetermined = int(np.sum(np.asarray(known.deviations) > 0.9 * config.prior))
    return micrograph, outcome, deviation, undetermined


def _counterparts(
    config: Config, micrograph: Micrograph, tissue: Tissue
) -> Int[np.ndarray, "pairs 2"]:
    """Whole cells of the segmented mesh, and the true cells whose centre is in the same place."""
    whole, found = np.flatnonzero(micrograph.whole), micrograph.segmentation
    pixel = float(np.sqrt(tissue.n_cells)) / config.microscope.pixels
    ours = np.asarray(found.tissue.centroids)[whole] / pixel_sides(found.pixel_size) * pixel
    away = tissue.boundary.shortest(jnp.asarray(ours)[:, None] - tissue.centroids[None])
    distance = np.asarray(jnp.linalg.norm(away, axis=-1))
    nearest = distance.argmin(axis=1)
    # Two cells that were taken for one, or one for two, have no counterpart.
    close = distance.min(axis=1) < 0.25
    single = np.bincount(nearest, minlength=tissue.n_cells)[nearest] == 1
    return np.stack([whole, nearest], axis=1)[close & single]


def _metrics(config: Config, found: list[_Image], snr: float) -> dict[str, Any]:
    own = [image for image in found if image.snr == snr]
    cells = {
        kind: np.concatenate([i.inferred for i in own if i.condition == kind] or [np.zeros(0)])
        for kind in ("stiff", "fluid")
    }
    metrics: dict[str, Any] = {
        "images": len(own),
        "images_wanted": 2 * config.images,
        "cells": sum(map(len, cells.values())),
    }
    if min(map(len, cells.values())) < 2:
        return metrics
    true, inferred, deviation = (
        np.concatenate([getattr(i, name) for i in own])
        for name in ("true", "inferred", "deviation")
    )
    within = {
        f"pearson_within_{kind}": pearson(
            np.concatenate([i.true for i in own if i.condition == kind]), cells[kind]
        )
        for kind in cells
    }
    test = mannwhitneyu(cells["fluid"], cells["stiff"], alternative="greater")
    return metrics | {
        "pearson": pearson(true, inferred),
        **within,
        "error_rms": np.sqrt(np.mean((inferred - true) ** 2)),
        "error_mean": np.mean(inferred - true),
        "deviation_median": np.median(deviation),
        "within_two_deviations": np.mean(np.abs(inferred - true) < 2 * deviation),
        "undetermined_combinations": np.mean([i.num_undetermined for i in own]),
        "image_correlation": np.mean([i.correlation for i in own]),
        "stiff_mean": cells["stiff"].mean(),
        "fluid_mean": cells["fluid"].mean(),
        "fluid_is_larger": test.statistic / (len(cells["fluid"]) * len(cells["stiff"])),
        "p_value": test.pvalue,
    }


def _save_table(found: list[_Image], folder: RunFolder) -> None:
    rows = [
        (i.condition, i.number, i.snr, t, p, d)
        for i in found
        for t, p, d in zip(i.true, i.inferred, i.deviation, strict=True)
    ]
    names = ("condition", "image", "snr", "true", "inferred", "deviation")
    folder.save_table("cells", dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)))
