"""Relative tensions and pressures of a cluster of cells, from its geometry alone.

A free cluster is seen as a segmented image: outlines of its cells, or labels. Each of its edges becomes
an arc, and the foam model E2 (a tension in each edge, a pressure in each cell) is fitted until its
equilibrium has the edges that were seen. A shape tells tensions and pressures but for one factor: they
are given relative to the mean tension. Without an image a cluster of known tensions is drawn and
segmented, to see how well they are found.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from matplotlib.path import Path
from pydantic import Field, model_validator
from scipy.optimize import lsq_linear

from vertax.costs import AbstractLeastSquaresCost, EdgeDistance
from vertax.energies import AbstractEnergy, AreaElasticity, BoundedTension, LocalSum
from vertax.experiments._design import terms_of
from vertax.experiments._scenes import pearson_of
from vertax.experiments.infer_tensions import figures
from vertax.fitting import Fit, FitError, InverseProblem, uncertainty
from vertax.initialise import Segmentation, free_voronoi, from_labels, labels_from_skeleton
from vertax.io import read_image
from vertax.mesh import Tissue
from vertax.plotting import cell_polygons, label_colours
from vertax.responses import equilibrate
from vertax.runs._config import ExperimentConfig, Section
from vertax.runs._folder import RunFolder
from vertax.runs._sections import Relaxation
from vertax.runs._tables import fit_metrics, history_columns


class ImageSection(Section):
    """The segmented image."""

    path: str = ""
    """Its file; left out, an image of a synthetic cluster."""
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


class Model(Section):
    """The foam model."""

    inner_arcs: bool = True
    """Whether edges between two cells are arcs too, whose curvature tells differences of pressure."""
    stiffness: float = Field(default=20.0, gt=0)
    """Stiffness of the areas, relative to the mean tension."""
    low: float = Field(default=0.05, ge=0, lt=1)
    """Least relative tension."""
    high: float = Field(default=4.0, gt=1)
    """Largest relative tension."""
    prior: float = Field(default=0.5, gt=0)
    """Standard deviation of relative tensions before the image was seen; it decides what the geometry
    leaves open."""
    noise: float = Field(default=1.0, gt=0)
    """Standard deviation of the position of an edge, in pixels: how much the image counts against that."""


class Config(ExperimentConfig):
    """Configuration of this experiment."""

    experiment: Literal["infer_tensions"] = "infer_tensions"
    """Which experiment this is."""
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


class RelativeTensions(AbstractLeastSquaresCost):
    r"""Penalty for tensions that differ from 1: $\tfrac12\sum_e ((\gamma_e - 1)/\sigma)^2$."""

    deviation: float

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Differences over the standard deviation."""
        return (tension_of(energy) - 1) / self.deviation


def tension_of(energy: AbstractEnergy) -> Float[Array, " edges"]:
    """Tensions of the edges.

    **Arguments:**

    - `energy`: of this experiment.

    **Returns:** the tensions.
    """
    return terms_of(energy)[1].tension


def run(config: Config, folder: RunFolder, *, progress: bool = True) -> dict[str, Any]:
    """Run the experiment.

    **Arguments:**

    - `config`: its configuration.
    - `folder`: where the results go.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the metrics: distances of the edges from those of the image in pixels (for tensions that
    are all equal, those that balance forces best in the shape as it was seen, and the fitted ones),
    spread and uncertainty of tensions and pressures; for a synthetic cluster how well they were found.

    **Raises:**

    - `FileNotFoundError` and `ValueError` for an image that cannot be used; `FitError` if the fit cannot
        go on.
    """
    truth = None
    if config.image.path:
        image = np.asarray(read_image(config.image.path))
        skeleton = config.image.kind == "skeleton"
        labels = labels_from_skeleton(image) if skeleton else image
        picture = np.asarray(image != 0, float) if skeleton else label_colours(labels)
    else:
        truth, labels = _synthetic(config)
        picture = label_colours(labels)
    found = from_labels(labels, boundary="free", inner_arcs=config.model.inner_arcs)
    folder.save_tissue("target", found.tissue)
    problem, balanced = problem_of(config, found)
    try:
        solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
        outcome = folder.fit("tensions", problem, solver, config.epochs, progress=progress)
    except FitError as error:
        if error.fit is not None:
            folder.save_table("history", history_columns(error.fit.history))
        raise
    folder.save_tissue("fitted", outcome.tissue)
    folder.save_table("history", history_columns(outcome.history))
    result = _result(config, problem, outcome)
    edges, cells = _tables(found, outcome, result, truth)
    folder.save_table("edges", edges)
    folder.save_table("cells", cells)
    folder.save_figure(
        "tensions",
        figures.foam(
            picture,
            found,
            outcome.tissue,
            result.tension,
            result.pressure,
        ),
    )
    if truth is not None:
        folder.save_figure("recovery", figures.recovery(edges, cells))
    return _metrics(config, found, balanced, outcome, result, edges, cells)


def problem_of(config: Config, found: Segmentation) -> tuple[InverseProblem, LocalSum]:
    """The inverse problem of a segmented cluster.

    **Arguments:**

    - `config`: the configuration.
    - `found`: the cluster.

    **Returns:** the problem, and the energy that it starts from.
    """
    model = config.model
    guess = balance(found.tissue, model)
    trainable = jax.tree.map(lambda _: False, guess)
    trainable = eqx.tree_at(
        lambda e: (e.terms[0].target_area, e.terms[1].logits), trainable, (True, True)
    )
    width = model.noise * found.pixel_size
    cost = EdgeDistance(found.tissue)
    # As many independent positions as edges have ends: each is known to within the noise.
    n_positions = 2 * found.tissue.n_vertices
    total = cost + width**2 / n_positions * RelativeTensions(model.prior)
    problem = InverseProblem(
        found.tissue, guess, total, trainable, fit_position=True, **config.relaxation.options()
    )
    return problem, guess


def balance(tissue: Tissue, model: Model) -> LocalSum:
    r"""Tensions and pressures that come closest to a balance of forces in a given shape.

    Forces on vertices and angles are linear in both, so this is a linear least-squares problem, with the
    mean tension 1 and the prior of the model.

    **Arguments:**

    - `tissue`: the shape.
    - `model`: bounds, stiffness and prior.

    **Returns:** the energy E2 with these tensions and with target areas that make these pressures.
    """
    position, unravel = ravel_pytree(tissue.configuration)

    def measures(x: Float[Array, " n"]) -> Float[Array, " edges_and_cells"]:
        at = tissue.with_configuration(unravel(x))
        return jnp.concatenate([at.edge_lengths, -at.areas])

    forces = np.asarray(jax.jit(jax.jacrev(measures))(position)).T
    n_edges, n_cells = tissue.n_edges, tissue.n_cells
    # A typical force is one tension; the prior counts as much as a hundredth of one.
    prior = 0.01 / model.prior * np.eye(n_edges, n_edges + n_cells)
    mean = np.concatenate([np.full(n_edges, 1e3 / n_edges), np.zeros(n_cells)])
    matrix = np.vstack([forces, prior, mean])
    right = np.concatenate([np.zeros(len(forces)), prior.sum(axis=1), [1e3]])
    margin = 1e-3 * (model.high - model.low)
    low = np.concatenate([np.full(n_edges, model.low + margin), np.full(n_cells, -np.inf)])
    high = np.concatenate([np.full(n_edges, model.high - margin), np.full(n_cells, np.inf)])
    solution = lsq_linear(matrix, right, (low, high)).x
    tension, pressure = np.split(np.asarray(solution), [n_edges])
    areas = tissue.areas + jnp.asarray(pressure / model.stiffness)
    return _foam(model, jnp.asarray(tension), areas)


def _foam(model: Model, tension: Float[Array, " edges"], areas: Float[Array, " cells"]) -> LocalSum:
    return LocalSum(
        (
            AreaElasticity(model.stiffness, areas),
            BoundedTension(tension, model.low, model.high),
        )
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
    energy = _foam(model, tension / jnp.mean(tension), areas)
    free = Relaxation(t1_threshold=0.02).options()
    relaxed = equilibrate(cluster, energy, **free).tissue
    corners = np.asarray(relaxed.edge_points(jnp.linspace(0, 1, 40)), float).reshape(-1, 2)
    low, extent = corners.min(axis=0), np.ptp(corners, axis=0)
    scale = 0.9 * options.pixels / extent.max()
    offset = 0.05 * options.pixels - low * scale
    shape = tuple(np.ceil(extent[::-1] * scale + 0.1 * options.pixels).astype(int).tolist())
    labels = np.zeros(shape, np.int32)
    centres = np.indices(shape)[::-1].reshape(2, -1).T + 0.5
    polygons, sides = cell_polygons(relaxed, points_per_arc=60)
    for number, (outline, size) in enumerate(zip(polygons, sides, strict=True), start=1):
        inside = Path(outline[:size] * scale + offset).contains_points(centres)
        labels[inside.reshape(shape)] = number
    return (energy, relaxed), labels


class Result(NamedTuple):
    """What was inferred, relative to the mean tension, where the mean area of a cell is 1."""

    tension: Float[np.ndarray, " edges"]
    tension_deviation: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    pressure_deviation: Float[np.ndarray, " cells"]


def _result(config: Config, problem: InverseProblem, outcome: Fit) -> Result:
    """Tensions and pressures with their standard deviations (Laplace approximation)."""
    parameters, constants = eqx.partition(outcome.energy, problem.trainable)
    flat, unravel = ravel_pytree(parameters)
    options = config.relaxation.options()

    # Areas follow their targets, so a pressure changes with the equilibrium.
    def relative(x: Float[Array, " parameters"]) -> Float[Array, " edges_and_cells"]:
        energy = eqx.combine(unravel(x), constants)
        area, tension = terms_of(energy)
        relaxed = equilibrate(outcome.tissue, energy, **options, throw=False).tissue
        values = jnp.concatenate([tension.tension, area.pressures(relaxed)])
        return values / jnp.mean(tension.tension)

    slopes = jax.jit(jax.jacfwd(relative))(flat)
    # Points of one edge move together: a mesh has no more independent positions than vertices and angles.
    # The prior adds one residual an edge.
    n_edges, n_vertices = outcome.tissue.n_edges, outcome.tissue.n_vertices
    angles = int(outcome.tissue.is_arc.sum())
    known = uncertainty(problem, outcome, n_independent=2 * n_vertices + angles + n_edges)
    covariance = slopes @ known.covariance @ slopes.T
    values, deviations = np.asarray(relative(flat)), np.sqrt(np.diag(np.asarray(covariance)))
    return Result(values[:n_edges], deviations[:n_edges], values[n_edges:], deviations[n_edges:])


def _tables(
    found: Segmentation, outcome: Fit, result: Result, truth: tuple[LocalSum, Tissue] | None
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
        area, tension = terms_of(energy)
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
    found: Segmentation,
    balanced: LocalSum,
    outcome: Fit,
    result: Result,
    edges: dict[str, np.ndarray],
    cells: dict[str, np.ndarray],
) -> dict[str, Any]:
    equal = balance(found.tissue, config.model.model_copy(update={"prior": 1e-3}))
    cost = EdgeDistance(found.tissue)
    options = config.relaxation.options()

    @eqx.filter_jit
    def distance(energy: LocalSum) -> Float[Array, ""]:
        relaxed = equilibrate(found.tissue, energy, **options, throw=False).tissue
        away = jnp.mean(relaxed.vertices - found.tissue.vertices, axis=0)
        return cost(relaxed.with_vertices(relaxed.vertices - away), energy)

    energies = {"equal": equal, "balanced": balanced, "fitted": outcome.energy}
    metrics: dict[str, Any] = {
        f"rms_distance_pixels_{name}": float(jnp.sqrt(2 * distance(energy))) / found.pixel_size
        for name, energy in energies.items()
    }
    # The outline of a cluster that was cut out of a tissue has corners where cells beyond it met, which no
    # arc has.
    inner = ~np.asarray(found.tissue.topology.on_outline)
    squared = np.sum(
        np.square(cost.residuals(outcome.tissue, balanced)).reshape(len(inner), -1), axis=1
    )
    lengths = np.asarray(found.tissue.edge_lengths)
    squared_inner = squared[inner].sum() * lengths.sum() / lengths[inner].sum()
    metrics |= {
        "rms_distance_pixels_inner": np.sqrt(squared_inner) / found.pixel_size,
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
            metrics[f"pearson_{name}"] = pearson_of(true[known][None], values[name][known][None])[0]
            metrics[f"rms_error_{name}"] = np.sqrt(np.mean((values[name] - true)[known] ** 2))
    return metrics | fit_metrics(outcome)
