"""The observed angles of a shape and their noise, and the forces that they determine."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, diags_array

from vertax._base.sparse_normal import SparseNormal, spread_parts
from vertax.tensions._balance import Equations, angle_slopes, angles, pulls
from vertax.tensions._curves import Fitted
from vertax.tensions._errors import Errors
from vertax.tensions._observed_geometry import ObservedGeometry

# An edge is loose if the standard deviation of its direction, in radians, is larger than the first, or if it
# is shorter than the second times the noise, or the third times the size of a cell.
_LOOSE, _SHORT, _TINY = 0.2, 8.0, 0.02
# Smallest and largest standard deviations: of directions and arcs in radians, of pressures, and of tensions
# in mean tensions. Tensions that are not negative and uniform about a mean of 1 have 0.58. Of arcs in noise,
# the evidence underestimates the independent part.
_JUNCTIONS, _ARCS, _PRESSURES = (2e-3, 1.5), (1e-3, 1.5), (0.01, 10.0)
_STRAIGHT_JUNCTIONS = (1e-3, 1.5)
_TENSIONS, _ARC_TENSIONS = (0.03, 0.6), (0.3, 0.6)
# Smallest noise relative to that of the points, of smooth and of rough outlines, and the largest: pixels
# along a straight line deviate from it by a pattern that averages out, rough outlines do not.
_LESS, _ROUGH_LESS, _MORE = 0.1, 0.7, 2.0
# The same for vertices of straight edges without an image, with a noise that is not known beforehand.
_VERTICES = (0.01, 50.0)
# Length of an edge, in cell diameters, below which the error of its arc does not decrease.
_SHORTEST = 0.25
# Effect of the half-angle and the two bends on the directions at the two ends, and on the angle of the arc.
_ENDS = np.array([[-1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, 0.0, 0.0]])
# Largest number of junctions of a tissue that is a single patch, and that of the patches of a larger one.
_WHOLE, _PATCH = 320, 160


class Observability(NamedTuple):
    """The observed angles of a shape, their noise, and which forces they determine.

    The noise of the angles is that of the vertices, and of each edge between its ends. Unknowns of edges are
    eliminated, so that only vertices remain.
    """

    angle: Float[np.ndarray, " angles"]
    """Directions at junctions, and angles of arcs."""
    edge: Int[np.ndarray, " angles"]
    """Edge of each angle."""
    slot: Int[np.ndarray, " angles"]
    """0 and 1 for the directions at its first and last vertex, 2 for its arc."""
    vertices: csc_array
    """Inverse covariance of the coordinates of vertices, due to the noise of points."""
    slopes: csr_array
    """Slopes of the angles by these coordinates, if each edge follows its points."""
    edge_covariance: Float[np.ndarray, "edges 3 3"]
    """Covariance of the angles of each edge at given vertices."""
    length: Float[np.ndarray, " edges"]
    """Lengths of chords, in cell diameters."""
    loose: Bool[np.ndarray, " edges"]
    """Edges too short for a direction."""
    loose_forces: csr_array
    """Coefficients of the unknown forces of loose edges. The force at one end is opposite to that at the
    other, so that the balance of both ends together remains."""
    size: float
    """Root of the mean area of a cell."""
    bounds: dict[str, tuple[float, float]]
    """Smallest and largest standard deviations of errors and priors."""
    place: tuple[Float[np.ndarray, "places 2"], ...]
    """Positions of coordinates, junctions, edges and cells."""

    def shares(self) -> tuple[Float[np.ndarray, " angles"], Float[np.ndarray, " angles"]]:
        """Variances of the angles for errors of directions, and of arcs, of size 1."""
        arc = np.where(self.slot == 2, np.maximum(self.length, _SHORTEST)[self.edge] ** 2, 0.0)
        return np.where(self.slot < 2, 1.0, 0.0), arc

    def model_deviations(self, errors: Errors) -> Float[np.ndarray, " angles"]:
        """Standard deviations of the angles due to errors of the model."""
        direction, arc = self.shares()
        return np.sqrt(errors.junction**2 * direction + errors.arc**2 * arc + self.unknown_arcs)

    @property
    def unknown_arcs(self) -> Float[np.ndarray, " angles"]:
        """Variances of the arcs of loose edges, which have no angle either: 1; and 0 of other angles."""
        return np.where((self.slot == 2) & self.loose[self.edge], 1.0, 0.0)

    def precision(self, errors: Errors) -> csr_array:
        """Inverse covariance of the angles at given vertices, due to noise and errors of the model."""
        angle = np.full(self.edge_covariance.shape[:2], -1)
        angle[self.edge, self.slot] = np.arange(len(self.edge))
        blocks, present = errors.noise**2 * self.edge_covariance, angle >= 0
        blocks[~present] = 0
        blocks.transpose(0, 2, 1)[~present] = 0
        each = np.arange(3)
        blocks[:, each, each] += ~present
        blocks[self.edge, self.slot, self.slot] += self.model_deviations(errors) ** 2
        blocks = np.linalg.inv(blocks)
        pair = present[:, :, None] & present[:, None, :]
        row, column = (
            np.broadcast_to(x, pair.shape)[pair] for x in (angle[:, :, None], angle[:, None])
        )
        return csr_array(coo_array((blocks[pair], (row, column)), shape=2 * (len(self.edge),)))

    def covariance(self) -> Float[np.ndarray, "angles angles"]:
        """Covariance of the angles due to noise, a dense matrix, of a patch."""
        dense = self.slopes.toarray()
        covariance = dense @ SparseNormal(self.vertices, self.place[0]).covariances(dense.T)
        same = self.edge[:, None] == self.edge
        return covariance + np.where(
            same, self.edge_covariance[self.edge[:, None], self.slot[:, None], self.slot], 0
        )


def observability(
    fitted: ObservedGeometry,
    curves: Fitted,
    which: Equations,
    uncertain: Bool[np.ndarray, " all_edges"],
    *,
    prior: float | None,
    known_noise: bool,
) -> Observability:
    """The observed angles of a shape, and their noise.

    **Arguments:**

    - `fitted`, `curves`: the geometry and the noise.
    - `which`: the equations.
    - `uncertain`: edges that may be between other cells; they are loose, as those without a direction.
    - `prior`: standard deviation of tensions about 1; by default chosen by the evidence.
    - `known_noise`: whether the noise is at most that of the points.
    """
    corners = np.unique(fitted.ends[which.edges])
    coordinates = (2 * corners[:, None] + [0, 1]).ravel()
    n = len(which.edges)
    first = 2 * fitted.n_vertices
    bends = first + len(fitted.angle) + 2 * which.edges
    inner = np.stack([first + which.edges, bends, bends + 1], axis=1).ravel()
    # Half-angles and bends of an edge depend on each other and on its ends only.
    precision: Any = csr_array(curves.precision) / curves.noise**2
    of_edges = precision[inner]
    local = coo_array(of_edges[:, inner])
    blocks = np.zeros((n, 3, 3))
    np.add.at(blocks, (local.row // 3, local.row % 3, local.col % 3), local.data)
    blocks = np.linalg.inv(blocks)
    through = csr_array(of_edges[:, coordinates])
    indices = np.arange(n), np.arange(n + 1)
    follow = -csr_array(bsr_array((blocks, *indices)) @ through)
    vertices = csc_array(precision[coordinates][:, coordinates] + through.T @ follow)
    angle, lifted = angles(fitted, which)
    slopes: Any = csr_array(diags_array(lifted) @ angle_slopes(fitted, which))
    slopes = csr_array(slopes[:, coordinates] + slopes[:, inner] @ follow)
    forward = fitted.forward[which.junctions].ravel()
    arcs = np.arange(which.n_arcs)
    edge = np.concatenate([which.half_edge.ravel(), arcs])
    slot = np.concatenate([np.where(forward, 0, 1), np.full(len(arcs), 2)])
    edge_covariance = np.zeros((n, 3, 3))
    if which.lever is None:
        factor = np.ones((n, 3))
        factor[edge, slot] = lifted
        ends = factor[:, :, None] * _ENDS
        edge_covariance = ends @ blocks @ np.swapaxes(ends, 1, 2)

    ends = fitted.ends[which.edges]
    middle = fitted.place[ends[:, 0]] + 0.5 * fitted.chord[which.edges]
    count = np.maximum(np.bincount(which.sides.ravel(), minlength=len(which.cells)), 1)
    cells = [
        np.bincount(which.sides.ravel(), np.repeat(x, 2), len(which.cells)) / count
        for x in middle.T
    ]
    at_vertices = np.repeat(fitted.place[corners], 2, axis=0)
    place = at_vertices, fitted.place[which.junctions], middle, np.stack(cells, axis=1)

    directions = csr_array(slopes[: which.n_directions])
    each = SparseNormal(vertices, at_vertices).variances(directions)
    each += edge_covariance[edge, slot, slot][: which.n_directions]
    variance = np.zeros(n)
    np.maximum.at(variance, which.half_edge.ravel(), each)
    least = max(_SHORT * curves.noise, _TINY * fitted.size)
    loose = (variance > _LOOSE**2) | (which.chord < least)
    loose |= uncertain[which.edges]
    smallest = _LESS if curves.crisp else _ROUGH_LESS
    noise = _VERTICES if len(curves.rest) == 0 else (smallest, _MORE)
    bounds = {"noise": (noise[0], 1.0 if known_noise else noise[1])}
    if which.n_arcs:
        bounds |= {"junction": _JUNCTIONS, "arc": _ARCS}
    else:
        bounds |= {"junction": _STRAIGHT_JUNCTIONS, "pressure": _PRESSURES}
    if prior is None:
        bounds |= {"tension": _ARC_TENSIONS if which.n_arcs else _TENSIONS, "region": _TENSIONS}
    return Observability(
        angle=angle,
        edge=edge,
        slot=slot,
        vertices=vertices,
        slopes=slopes,
        edge_covariance=edge_covariance,
        length=which.chord / fitted.size,
        loose=loose,
        loose_forces=pulls(fitted, which, loose),
        size=fitted.size,
        bounds=bounds,
        place=place,
    )


def patches(fitted: ObservedGeometry, which: Equations) -> list[ObservedGeometry]:
    """The geometry with the balance of the junctions in a few compact parts of a large tissue only."""
    inner = []
    for part in spread_parts(fitted.place[which.junctions], _WHOLE, _PATCH):
        mine = np.zeros(fitted.n_vertices, bool)
        mine[which.junctions[part]] = True
        inner.append(mine)
    return [fitted._replace(inner=mine) for mine in inner]
