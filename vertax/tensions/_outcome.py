"""From tensions and pressures in balance to the result: relative numbers, and which are determined."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.mesh import Tissue, angle_of_area, geometry_of
from vertax.surfaces import AbstractSurface
from vertax.tensions._balance import Equations
from vertax.tensions._curves import Fitted, Points, arc_distances
from vertax.tensions._inferred import InferredTensions
from vertax.tensions._lift import curved_geometry
from vertax.tensions._mean_stress import fabric, mean_stress, stress_operators
from vertax.tensions._solve import HIDDEN, Balance

# A tension with a larger standard deviation, relative to the mean, is not determined.
_UNKNOWN = 0.3


class Relative(NamedTuple):
    """Tensions of mean 1, and pressures of mean 0."""

    tension: Float[np.ndarray, " tensions"]
    pressure: Float[np.ndarray, " pressures"]
    tension_deviation: Float[np.ndarray, " tensions"]
    pressure_deviation: Float[np.ndarray, " pressures"]
    beside: Bool[np.ndarray, " pressures"]
    """Whether a cell has an edge of determined tension."""
    sure: Bool[np.ndarray, " tensions"]
    """Whether a tension is determined, up to the error of the contrast of all."""
    lag: Float[np.ndarray, " unknowns"]
    """Standard deviations due to the contrast, an error that all tensions have in common."""


def relative(balance: Balance, which: Equations, curves: Fitted) -> Relative:
    """Tensions and pressures relative to their means over all edges and cells that have an equation.

    **Arguments:**

    - `balance`: the solution of the balance of forces, in which the mean of the tensions is 1.
    - `which`: the equations.
    - `curves`: the fitted edges.

    **Returns:** the [`Relative`][vertax.tensions._outcome.Relative] numbers.
    """
    n, n_cells = len(which.edges), len(which.cells)
    variance = balance.posterior.variances()
    sure = ~balance.loose & is_determined(np.sqrt(variance[:n]))
    beside = np.isin(np.arange(n_cells), which.sides[sure])
    # The mean of the pressures has an error too.
    mean = np.append(np.zeros(n), np.full(n_cells, 1 / n_cells))
    spread = balance.posterior.covariances(mean[:, None])[:, 0]
    variance[n:] += mean @ spread - 2 * spread[n:]
    # Friction along edges, which is the error of arcs, hides a part of the contrast of tensions from all
    # junctions alike: their angles follow the tensions late. As a force it is 2 γ times this error.
    # Friction bends edges too, so that it is not larger than bends where the points resolve them.
    friction = min(balance.errors.arc, curves.bending) if curves.bends else balance.errors.arc
    lag = HIDDEN * friction * np.append(balance.tension - 1, np.zeros(n_cells))
    deviation = np.sqrt(np.maximum(variance + lag**2, 0))
    pressure = balance.pressure - np.mean(balance.pressure)
    return Relative(balance.tension, pressure, deviation[:n], deviation[n:], beside, sure, lag)


def is_determined(deviation: Float[np.ndarray, " tensions"]) -> Bool[np.ndarray, " tensions"]:
    """Whether tensions of these standard deviations are determined."""
    return deviation < _UNKNOWN


def assembled(
    tissue: Tissue,
    places: tuple[Int[np.ndarray, " tensions"], Int[np.ndarray, " pressures"]],
    values: Relative,
    covariances: Callable[[np.ndarray], np.ndarray],
    *,
    four_fold: Bool[np.ndarray, " edges"],
    surface: AbstractSurface | None = None,
    **fields: Any,
) -> InferredTensions:
    """The result with arrays of all edges and cells, and stresses.

    **Arguments:**

    - `tissue`: the tissue.
    - `places`: the edges of the tensions, and the cells of the pressures.
    - `values`: the tensions and pressures.
    - `covariances`: the covariance matrix of the tensions and pressures times vectors.
    - `four_fold`: edges of length 0.
    - `surface`: the surface of the tissue; None in the plane.
    - `fields`: the other fields of the result.

    **Returns:** the [`InferredTensions`][vertax.tensions.InferredTensions].
    """
    tangents, areas = fabric(tissue), geometry_of(tissue).areas
    curved = None
    of_edges = lambda of, fill: spread(tissue.n_edges, places[0], of, fill)
    of_cells = lambda of, fill: spread(tissue.n_cells, places[1], of, fill)
    tensions, pressures = of_edges(values.tension, np.nan), of_cells(values.pressure, np.nan)
    if surface is not None:
        curved, tangents = curved_geometry(tissue, surface, tensions)
        areas = curved.areas
    operators = stress_operators(tissue, tangents, areas)
    # The mean is that of the cells with a pressure and tensions of all their edges.
    missing = ~spread(tissue.n_edges, places[0], True, False)
    included = spread(tissue.n_cells + 1, places[1], True, False)
    included[geometry_of(tissue).edge_cells[missing]] = False
    included = included[:-1]
    columns = np.concatenate([places[0], tissue.n_edges + places[1]])
    total = max(float(np.sum(areas[included])), 1e-300)
    weights = np.stack([included @ operator for operator in operators])[:, columns] / total
    components = weights @ np.concatenate([values.tension, values.pressure])
    # Pressures are less their mean.
    n, lag = len(values.tension), weights @ values.lag
    weights[:, n:] -= weights[:, n:].mean(axis=1, keepdims=True)
    covariance = weights @ covariances(weights.T) + np.outer(lag, lag)
    determined = of_edges(values.sure, False) & ~four_fold
    certain = np.append(np.where(determined, tensions, np.nan), pressures)
    stresses = np.stack([operator @ certain / areas for operator in operators], axis=1)
    return InferredTensions(
        tissue=tissue,
        tensions=tensions,
        tension_deviations=of_edges(values.tension_deviation, np.nan),
        determined=determined,
        pressures=pressures,
        pressure_deviations=of_cells(values.pressure_deviation, np.nan),
        pressures_determined=of_cells(values.beside, False),
        stresses=stresses[:, [[0, 1], [1, 2]]],
        mean_stress=mean_stress(components, covariance, int(included.sum())),
        four_fold=four_fold,
        curved=curved,
        **fields,
    )


def spread(size: int, place: Int[np.ndarray, " some"], of: Any, fill: Any) -> np.ndarray:
    """An array with values at some places."""
    array = np.full(size, fill)
    array[place] = of
    return array


def outline_errors(
    tissue: Tissue, points: Points, change: Float[np.ndarray, " geometry"]
) -> Float[np.ndarray, " cells"]:
    """Root mean square distance of the points around each cell from its arcs."""
    geometry, edge = geometry_of(tissue), points.edge
    p = _from_moved_vertices(tissue, points, change)
    distance = arc_distances(geometry.edge_vectors[edge], geometry.edge_angles[edge], p)
    total, count = np.zeros((2, tissue.n_cells + 1))
    for side in geometry.edge_cells.T:
        np.add.at(total, side[edge], distance**2)
        np.add.at(count, side[edge], 1)
    return np.sqrt(total / np.maximum(count, 1))[:-1]


def _from_moved_vertices(
    tissue: Tissue, points: Points, change: Float[np.ndarray, " geometry"]
) -> Float[np.ndarray, "points 2"]:
    """The points relative to the first vertices of their edges after these moved."""
    shift = change[: 2 * tissue.n_vertices].reshape(-1, 2)
    return points.away - shift[geometry_of(tissue).edge_vertices[points.edge, 0]]


def with_outline_of_mask(
    tissue: Tissue,
    points: Points,
    change: Float[np.ndarray, " geometry"],
    fitted: Int[np.ndarray, " some"],
) -> Tissue:
    """The tissue with arcs of the areas in the mask in place of those that were not fitted.

    The ends of an edge on the outline move along the edges that end there, and its angle has to follow.
    """
    geometry, edge = geometry_of(tissue), points.edge
    p, chord = _from_moved_vertices(tissue, points, change), geometry.edge_vectors
    # Area between the points and the chord, right of the chord.
    same = edge[1:] == edge[:-1]
    last = np.append(edge[1:] != edge[:-1], True)
    area = np.zeros(tissue.n_edges)
    np.add.at(area, edge[:-1][same], 0.5 * np.linalg.det(np.stack([p[:-1], p[1:]], 1)[same]))
    np.add.at(area, edge[last], 0.5 * np.linalg.det(np.stack([p[last], chord[edge[last]]], 1)))
    other = np.zeros(tissue.n_edges, bool)
    other[edge] = True
    other[fitted] = False
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
    angles = np.where(other, angle_of_area(area, length), geometry.edge_angles)
    return tissue.with_angles(jnp.asarray(angles, tissue.vertices.dtype))


def moved_by_fit(tissue: Tissue, change: Float[np.ndarray, " geometry"]) -> Tissue:
    """The tissue with the vertices and angles of the fit."""
    n = 2 * tissue.n_vertices
    dtype = tissue.vertices.dtype
    # In NumPy: JAX would compile for each size.
    vertices = np.asarray(tissue.vertices) + change[:n].reshape(-1, 2)
    angles = geometry_of(tissue).edge_angles + change[n : n + tissue.n_edges]
    moved = tissue.with_vertices(jnp.asarray(vertices, dtype))
    if tissue.arcs is None:
        return moved
    return moved.with_angles(jnp.asarray(angles, dtype))
