"""The balance of forces at junctions and along arcs, in terms of angles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array

from vertax.tensions._observed_geometry import ObservedGeometry


class Equations(NamedTuple):
    """The equations of the balance of forces: their junctions, and the edges and cells that are unknowns."""

    junctions: Int[np.ndarray, " junctions"]
    """Vertices where three cells meet: two components of force at each."""
    edges: Int[np.ndarray, " edges"]
    """Edges that end at a junction: their tensions are unknowns, and each arc has an equation."""
    cells: Int[np.ndarray, " cells"]
    """Cells next to these edges: their pressures are unknowns."""
    half_edge: Int[np.ndarray, "junctions 3"]
    """Edges that meet at each junction, as indices into `edges`."""
    sides: Int[np.ndarray, "edges 2"]
    """Cells on the left and on the right of each edge, as indices into `cells`."""
    chord: Float[np.ndarray, " edges"]
    """Distance between the ends of each edge."""
    lever: Float[np.ndarray, "junctions 3 2"] | None
    """Of straight edges, the chords away from each junction, on which pressures act; None for arcs."""
    beside: Int[np.ndarray, "junctions 3 2"]
    """Cells on the left and on the right of each edge on the way from the junction."""

    @property
    def n_rows(self) -> int:
        """Number of equations."""
        return 2 * len(self.junctions) + self.n_arcs

    @property
    def n_directions(self) -> int:
        """Number of directions at junctions, which come before the angles of arcs."""
        return 3 * len(self.junctions)

    @property
    def n_arcs(self) -> int:
        """Number of equations of arcs."""
        return len(self.edges) if self.lever is None else 0


def equations(geometry: ObservedGeometry, *, straight: bool = False) -> Equations:
    """The equations of all junctions that do not touch the exterior, for arcs or for straight edges."""
    junctions = np.flatnonzero(geometry.inner)
    edges = np.unique(geometry.half_edge[junctions])
    cells = np.unique(geometry.cells[edges])
    half_edge = geometry.half_edge[junctions]
    forward = geometry.forward[junctions][:, :, None]
    sides = geometry.cells[half_edge]
    chord = np.linalg.norm(geometry.chord[edges], axis=1)
    lever = np.where(forward, 1, -1) * geometry.chord[half_edge]
    if geometry.lift is not None:
        chord = geometry.lift.chord[edges]
        lever = np.einsum("vij,vlj->vli", geometry.lift.root[junctions], lever)
        lever += geometry.lift.offset[junctions]
    return Equations(
        junctions=junctions,
        edges=edges,
        cells=cells,
        half_edge=np.searchsorted(edges, half_edge),
        sides=np.searchsorted(cells, geometry.cells[edges]),
        chord=np.maximum(chord, 1e-6 * geometry.size),
        lever=lever if straight else None,
        beside=np.searchsorted(cells, np.where(forward, sides, sides[:, :, ::-1])),
    )


# At a junction the sum of γ t is zero, with the tangents t of its edges. An arc with the angle α over the
# chord c is in balance with the pressures on its two sides if 2 γ sin α = (p_left - p_right) |c|: the law of
# Laplace, times the length of the chord. Both are forces, linear in tensions and pressures, and functions of
# angles: the directions of the tangents, away from their junctions, and the α.
# A straight edge with the chord c passes the force ½ (p_left - p_right) (c_y, -c_x) of the pressures on to
# each of its ends (Ishihara & Sugimura 2012, doi:10.1016/j.jtbi.2012.08.017). Together with the tension this
# is the pull of an arc, to first order in α, and the law of Laplace is no separate equation.
# On a surface the directions are those in the tangent planes, and the α half of the geodesic turning.
def angles(
    geometry: ObservedGeometry, which: Equations
) -> tuple[Float[np.ndarray, " angles"], Float[np.ndarray, " angles"]]:
    """Directions of tangents, or of straight edges, three for each junction, and angles of arcs; and their
    derivatives by those in the image, which are 1 in the plane."""
    edge, forward = geometry.half_edge[which.junctions], geometry.forward[which.junctions]
    chord = np.arctan2(geometry.chord[:, 1], geometry.chord[:, 0])[edge]
    away, back, arc, length = chord, chord + np.pi, np.zeros(0), 1.0
    if which.n_arcs:
        middle, half = chord + geometry.bend[edge, 0], geometry.angle[edge]
        away = middle + geometry.bend[edge, 1] - half
        back = middle - geometry.bend[edge, 1] + half + np.pi
        arc = geometry.angle[which.edges]
    else:
        length = np.linalg.norm(geometry.chord, axis=1)[edge][..., None]
    direction, lift = np.where(forward, away, back), geometry.lift
    if lift is None:
        return np.concatenate([direction.ravel(), arc]), np.ones(direction.size + len(arc))
    vectors = length * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    direction, rate = lift.turned(vectors, which.junctions, straight=which.n_arcs == 0)
    first, slope = lift.turn[which.edges[: len(arc)]].T
    lifted = np.concatenate([direction.ravel(), first + slope * arc])
    return lifted, np.concatenate([rate.ravel(), slope])


def angle_slopes(geometry: ObservedGeometry, which: Equations) -> csr_array:
    """Jacobian of the angles in the image with respect to vertices, angles and bends."""
    edge, forward = (
        geometry.half_edge[which.junctions].ravel(),
        geometry.forward[which.junctions].ravel(),
    )
    across = np.stack([-geometry.chord[:, 1], geometry.chord[:, 0]], axis=1)
    across /= np.maximum(np.sum(geometry.chord**2, axis=1), (1e-3 * geometry.size) ** 2)[:, None]
    first = 2 * geometry.n_vertices
    bends = first + len(geometry.angle)
    row = np.arange(which.n_directions)
    way = np.where(forward, 1.0, -1.0)
    entries = []
    if which.lever is None:
        entries = [(row, first + edge, -way), (row, bends + 2 * edge, np.ones(len(row)))]
        entries.append((row, bends + 2 * edge + 1, way))
    for end, sign in ((0, -1.0), (1, 1.0)):
        for axis in range(2):
            entries.append((row, 2 * geometry.ends[edge, end] + axis, sign * across[edge, axis]))
    if which.lever is None:
        arcs = which.n_directions + np.arange(which.n_arcs)
        entries.append((arcs, first + which.edges, np.ones(len(arcs))))
    return _matrix(entries, (which.n_directions + which.n_arcs, geometry.n_geometry))


def forces(
    angle: Float[np.ndarray, " angles"], which: Equations, loose: Bool[np.ndarray, " edges"]
) -> csr_array:
    """The matrix of the forces, which are linear in tensions and pressures.

    **Arguments:**

    - `angle`: directions and angles of arcs.
    - `which`: the equations.
    - `loose`: edges of unknown direction, which pull with a force of any direction.

    **Returns:** the matrix.
    """
    n_junctions, n_edges = len(which.junctions), len(which.edges)
    direction, arc = angle[: which.n_directions].reshape(-1, 3), angle[which.n_directions :]
    row, firm = 2 * np.arange(n_junctions)[:, None], np.where(loose, 0.0, 1.0)
    entries = [
        (row + component, which.half_edge, part * firm[which.half_edge])
        for component, part in enumerate((np.cos(direction), np.sin(direction)))
    ]
    if which.lever is not None:
        for side, sign in enumerate((0.5, -0.5)):
            for component, part in enumerate((which.lever[..., 1], -which.lever[..., 0])):
                entries.append((row + component, n_edges + which.beside[..., side], sign * part))
    else:
        row = 2 * n_junctions + np.arange(n_edges)
        entries.append((row, np.arange(n_edges), 2 * np.sin(arc)))
        for side, sign in enumerate((-1.0, 1.0)):
            entries.append((row, n_edges + which.sides[:, side], sign * which.chord))
    return _matrix(entries, (which.n_rows, n_edges + len(which.cells)))


def force_slopes(
    angle: Float[np.ndarray, " angles"], which: Equations, tension: Float[np.ndarray, " edges"]
) -> csr_array:
    """Jacobian of the forces with respect to the angles, at given tensions."""
    n_junctions = len(which.junctions)
    direction, arc = angle[: which.n_directions], angle[which.n_directions :]
    pull = tension[which.half_edge].ravel()
    row, column = np.repeat(2 * np.arange(n_junctions), 3), np.arange(which.n_directions)
    arcs = np.arange(which.n_arcs)
    entries = [
        (row, column, -pull * np.sin(direction)),
        (row + 1, column, pull * np.cos(direction)),
    ]
    stretch = 2 * tension[: which.n_arcs] * np.cos(arc)
    entries.append((2 * n_junctions + arcs, which.n_directions + arcs, stretch))
    return _matrix(entries, (which.n_rows, len(angle)))


def pulls(
    geometry: ObservedGeometry, which: Equations, chosen: Bool[np.ndarray, " edges"]
) -> csr_array:
    """Coefficients of forces of the chosen edges in the equations, two components each."""
    edges = np.flatnonzero(chosen)
    place = np.full(geometry.n_vertices, -1)
    place[which.junctions] = np.arange(len(which.junctions))
    entries = []
    for end, sign in ((0, 1.0), (1, -1.0)):
        at = place[geometry.ends[which.edges[edges], end]]
        inner = np.flatnonzero(at >= 0)
        for axis in range(2):
            entries.append((2 * at[inner] + axis, 2 * inner + axis, np.full(len(inner), sign)))
    return _matrix(entries, (which.n_rows, 2 * len(edges)))


def _matrix(
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int]
) -> csr_array:
    """The sparse matrix of rows, columns and values, added where they repeat."""
    rows, columns, values = (
        np.concatenate([np.broadcast_to(entry[k], entry[2].shape).ravel() for entry in entries])
        for k in range(3)
    )
    return csr_array(coo_array((values, (rows, columns)), shape=shape))
