"""The balance of forces at junctions and along arcs, solved for tensions and pressures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array

from vertax.inference._seen import Seen


class Equations(NamedTuple):
    """Which balances are written down, of what."""

    junctions: Int[np.ndarray, " junctions"]
    """Where three cells meet: two components of force at each."""
    edges: Int[np.ndarray, " edges"]
    """Those that end at one: their tensions are asked for, and each has its balance of pressures."""
    cells: Int[np.ndarray, " cells"]
    """The cells beside them, whose pressures are asked for."""
    edge_place: Int[np.ndarray, " all_edges"]
    cell_place: Int[np.ndarray, " all_cells"]

    @property
    def n_rows(self) -> int:
        """Number of equations."""
        return 2 * len(self.junctions) + len(self.edges)


def equations(seen: Seen) -> Equations:
    """The balances that hold whatever is beyond the outline."""
    junctions = np.flatnonzero(seen.inner)
    edges = np.unique(seen.half_edge[junctions])
    cells = np.unique(seen.cells[edges])
    edge_place, cell_place = np.full(len(seen.angle), -1), np.full(seen.n_cells + 1, -1)
    edge_place[edges], cell_place[cells] = np.arange(len(edges)), np.arange(len(cells))
    return Equations(junctions, edges, cells, edge_place, cell_place)


def _turned(x: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    return np.stack([-x[..., 1], x[..., 0]], axis=-1)


class Turns(NamedTuple):
    """By how much angles differ from those of a balance, which no noise explains: errors of the model."""

    junction: Float[np.ndarray, "junctions 3"]
    """Of the edges that meet at a junction."""
    arc: Float[np.ndarray, " edges"]
    """Of the arcs, for the balance of pressures."""


# At a junction the sum of γ t is zero, with the tangents t of its edges. An arc with the angle α over the
# chord c is in balance with the pressures on its two sides if 2 γ sin α = (p_left - p_right) |c|: the law of
# Laplace, times the length of the chord. Both are forces, and linear in tensions and pressures.
def forces(seen: Seen, which: Equations, turns: Turns) -> Float[np.ndarray, "rows unknowns"]:
    """The matrix that makes forces of tensions and pressures."""
    n_junctions, n_edges = len(which.junctions), len(which.edges)
    matrix = np.zeros((which.n_rows, n_edges + len(which.cells)))
    tangent = _tangents(seen, which, turns)
    column = which.edge_place[seen.half_edge[which.junctions]]
    row = np.arange(n_junctions)[:, None]
    for component in range(2):
        np.add.at(matrix, (2 * row + component, column), tangent[..., component])
    row = 2 * n_junctions + np.arange(n_edges)
    matrix[row, np.arange(n_edges)] = 2 * np.sin(seen.angle[which.edges] + turns.arc)
    chord = np.linalg.norm(seen.chord[which.edges], axis=1)
    left, right = which.cell_place[seen.cells[which.edges]].T + n_edges
    np.add.at(matrix, (row, left), -chord)
    np.add.at(matrix, (row, right), chord)
    return matrix


class Slopes(NamedTuple):
    """How forces change."""

    geometry: csc_array
    """With vertices and angles."""
    junction: Float[np.ndarray, "junctions 3 2"]
    """With the direction of each edge at a junction."""
    arc: Float[np.ndarray, " edges"]
    """With the angle of each arc alone."""


def slopes(
    seen: Seen,
    which: Equations,
    turns: Turns,
    tension: Float[np.ndarray, " edges"],
    step: Float[np.ndarray, " edges"],
) -> Slopes:
    """How forces change, at some tensions and differences of pressure (left - right)."""
    ends = 2 * seen.n_vertices
    chord = np.maximum(np.linalg.norm(seen.chord, axis=1), 1e-3 * seen.size)
    unit = seen.chord / chord[:, None]
    half = seen.half_edge[which.junctions]
    # A tangent turns with the chord and with the angle.
    pull = tension[which.edge_place[half]][..., None] * _turned(_tangents(seen, which, turns))
    by_chord = (_turned(unit) / chord[:, None])[half]
    by_angle = np.where(seen.forward[which.junctions], -1.0, 1.0)
    row = np.broadcast_to(2 * np.arange(len(half))[:, None], half.shape)
    rows, columns, values = [], [], []
    bends = ends + len(seen.angle) + 2 * half
    for component in range(2):
        force = pull[..., component]
        rows += [row + component] * 3
        columns += [ends + half, bends, bends + 1]
        values += [force * by_angle, force, -force * by_angle]
        for axis in range(2):
            for end, way in ((0, -1.0), (1, 1.0)):
                rows.append(row + component)
                columns.append(2 * seen.ends[half][..., end] + axis)
                values.append(way * force * by_chord[..., axis])
    row = 2 * len(half) + np.arange(len(which.edges))
    by_arc = 2 * tension * np.cos(seen.angle[which.edges] + turns.arc)
    rows.append(row)
    columns.append(ends + which.edges)
    values.append(by_arc)
    for axis in range(2):
        for end, way in ((0, 1.0), (1, -1.0)):
            rows.append(row)
            columns.append(2 * seen.ends[which.edges][:, end] + axis)
            values.append(way * step * unit[which.edges][:, axis])
    flat = lambda arrays: np.concatenate([np.ravel(x) for x in arrays])
    shape = (which.n_rows, seen.n_geometry)
    geometry = csc_array(coo_array((flat(values), (flat(rows), flat(columns))), shape=shape))
    return Slopes(geometry, pull, by_arc)


def _tangents(seen: Seen, which: Equations, turns: Turns) -> Float[np.ndarray, "junctions 3 2"]:
    """Unit vectors along the three edges of each junction, away from it."""
    chord = np.maximum(np.linalg.norm(seen.chord, axis=1), 1e-12 * seen.size)
    unit = seen.chord / chord[:, None]
    first, last = (
        np.cos(angle)[:, None] * unit + np.sin(angle)[:, None] * _turned(unit)
        for angle in (seen.bend[:, 0] + seen.bend[:, 1] - seen.angle, seen.bend[:, 0] - seen.bend[:, 1] + seen.angle)
    )
    half = seen.half_edge[which.junctions]
    along = np.where(seen.forward[which.junctions][..., None], first[half], -last[half])
    turn = turns.junction[..., None]
    return np.cos(turn) * along + np.sin(turn) * _turned(along)
