"""The arcs of a tissue as they were seen, and how exactly they are known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from vertax.mesh import Tissue

# Standard deviations of what no point tells, such as the angle of an edge of two pixels: of a vertex in
# cell diameters and of an angle in radians.
_VERTEX, _ANGLE = 2.0, 0.5


class Seen(NamedTuple):
    """The geometry of a tissue on the host: numbers, and arcs in terms of chords and angles.

    What is known of it are displacements of the vertices and changes of the angles, in one vector.
    """

    ends: Int[np.ndarray, "edges 2"]
    cells: Int[np.ndarray, "edges 2"]
    """On the left and on the right; the exterior is the number of cells."""
    half_edge: Int[np.ndarray, "vertices 3"]
    """The edge of each half-edge that leaves a vertex."""
    forward: Bool[np.ndarray, "vertices 3"]
    """Whether it runs in the direction of its edge."""
    chord: Float[np.ndarray, "edges 2"]
    angle: Float[np.ndarray, " edges"]
    bend: Float[np.ndarray, "edges 2"]
    """By how much the curve is turned from its arc: at both ends alike, and at its first end and back at its
    last."""
    n_cells: int
    inner: Bool[np.ndarray, " vertices"]
    """Where three cells meet, and not the exterior."""
    size: float
    """Root of the mean area of a cell."""

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.inner)

    def moved(self, change: Float[np.ndarray, " geometry"]) -> Seen:
        """With vertices and angles elsewhere."""
        angles, bends = 2 * self.n_vertices, 2 * self.n_vertices + len(self.angle)
        shift = change[:angles].reshape(-1, 2)
        return self._replace(
            chord=self.chord + shift[self.ends[:, 1]] - shift[self.ends[:, 0]],
            angle=self.angle + change[angles:bends],
            bend=self.bend + change[bends:].reshape(-1, 2),
        )

    @property
    def n_geometry(self) -> int:
        """Number of coordinates, angles and bends."""
        return 2 * self.n_vertices + 3 * len(self.angle)


def seen(tissue: Tissue) -> Seen:
    """The geometry of a tissue."""
    m = tissue.topology
    edge, forward, cell = (np.asarray(x) for x in (m.edge, m.forward, m.cell))
    inner = np.all(cell.reshape(-1, 3) < tissue.n_cells, axis=1)
    return Seen(
        ends=np.asarray(m.edge_vertices),
        cells=np.asarray(m.edge_cells),
        half_edge=edge.reshape(-1, 3),
        forward=forward.reshape(-1, 3),
        chord=np.asarray(tissue.edge_vectors, float),
        angle=np.asarray(tissue.edge_angles, float),
        bend=np.zeros((tissue.n_edges, 2)),
        n_cells=tissue.n_cells,
        inner=inner,
        size=float(np.sqrt(np.mean(np.abs(np.asarray(tissue.areas, float))))),
    )


class Fitted(NamedTuple):
    """Arcs fitted to points, and the covariance of the fit, but for the square of the noise."""

    change: Float[np.ndarray, " geometry"]
    """From the geometry of the tissue to that of the fit."""
    precision: csc_array
    """The inverse covariance of vertices and angles, where a point has the standard deviation 1."""
    noise: float
    """Root mean square distance of the points from the arcs."""
    rest: Float[np.ndarray, " points"]
    """The distance of each."""


def fit_arcs(
    tissue: Seen,
    edge: Int[np.ndarray, " points"],
    away: Float[np.ndarray, "points 2"],
    pixel_size: float,
    apart: float,
    *,
    bending: float = 0.0,
    noise: float | None = None,
    rounds: int = 6,
) -> Fitted:
    """Vertices and angles such that the arcs run through points as well as they can.

    An arc from 0 with the chord $c$ whose tangent there is turned by $\\varphi$ from it has a distance from a
    point $p$ of

    $$d = \\frac{p \\cdot (p - c)\\, \\sin\\varphi + (c \\times p) \\cos\\varphi}{|c|}$$

    to first order in $d$, for every angle.

    **Arguments:**

    - `tissue`: the geometry to begin with.
    - `edge`: the edge of each point.
    - `away`: the points, each seen from the first vertex of its edge.
    - `pixel_size`: the grain of the points.
    - `apart`: how far points must lie apart to say something of their own, a length.
    - `rounds`: steps of Gauss and Newton.

    **Returns:** the [`Fitted`][vertax.inference._seen.Fitted] arcs.
    """
    n_vertices, n = tissue.n_vertices, tissue.n_geometry
    bends = 2 * n_vertices + len(tissue.angle)
    start, end = tissue.ends[edge].T
    n_points = np.bincount(edge, minlength=len(tissue.angle))
    length = np.linalg.norm(tissue.chord, axis=1)
    # Each edge counts as so many points as are far enough apart, and as one if it is shorter than that.
    weight = length / apart / np.maximum(n_points, 1)
    weight = np.where(length > 3 * pixel_size, weight, 0.0)[edge]
    # What the points leave open stays where it was seen.
    noise = 0.4 * pixel_size if noise is None else noise
    held = np.concatenate(
        [
            np.full(2 * n_vertices, (noise / (_VERTEX * pixel_size)) ** 2),
            np.full(len(length), (noise / _ANGLE) ** 2),
            np.full(2 * len(length), (noise / max(bending, 1e-6)) ** 2),
        ]
    )
    columns = np.stack(
        [2 * start, 2 * start + 1, 2 * end, 2 * end + 1, 2 * n_vertices + edge,
         bends + 2 * edge, bends + 2 * edge + 1], axis=1
    )
    rows = np.repeat(np.arange(len(edge)), 7)
    change = np.zeros(n)
    rest = np.zeros(len(edge))
    normal = csc_array(diags_array(held))
    for _ in range(rounds):
        here = tissue.moved(change)
        p = away - change[: 2 * n_vertices].reshape(-1, 2)[start]
        c, angle = here.chord[edge], here.angle[edge]
        chord = np.maximum(np.linalg.norm(c, axis=1), 0.1 * pixel_size)
        q, sine, cosine = p - c, -np.sin(angle), np.cos(angle)
        dot, cross = np.sum(p * q, axis=1), c[:, 0] * p[:, 1] - c[:, 1] * p[:, 0]
        rest = (dot * sine + cross * cosine) / chord
        turn = np.stack([-q[:, 1], q[:, 0], p[:, 1], -p[:, 0]], axis=1)
        slide = np.concatenate([q, p], axis=1)
        slopes = (cosine[:, None] * turn - sine[:, None] * slide) / chord[:, None]
        bulge = (cross * sine + dot * -cosine) / chord
        wide = np.clip(np.abs(angle), 1e-3, 1.5)
        along = np.arcsin(np.minimum(np.linalg.norm(np.stack([p,q]), axis=2) * np.sin(wide) / chord, 1))
        u = along[0] / np.maximum(along[0] + along[1], 1e-300)
        flat = u * (1 - u)
        modes = -(chord * wide / np.sin(wide))[:, None] * np.stack([flat * (1 - 2 * u), flat * (1 - 14 / 3 * flat)], axis=1)
        rest = rest + np.sum(modes * here.bend[edge], axis=1)
        values = np.column_stack([slopes, bulge, modes])
        jacobian = csc_array(
            coo_array((values.ravel(), (rows, columns.ravel())), shape=(len(edge), n))
        )
        weighted = jacobian.T * weight
        normal = csc_array(weighted @ jacobian + diags_array(held))
        change = change - splu(normal).solve(weighted @ rest + held * change)
        turned = slice(2 * n_vertices, bends)
        change[turned] = np.clip(tissue.angle + change[turned], -3, 3) - tissue.angle
    return Fitted(change, normal, float(np.sqrt(np.sum(weight * rest**2) / np.sum(weight))), rest)


def correlation_length(
    edge: Int[np.ndarray, " points"],
    away: Float[np.ndarray, "points 2"],
    rest: Float[np.ndarray, " points"],
) -> float:
    """How far points must lie apart for their distances from arcs to be independent.

    The integral of the correlation along edges, up to where it is first lost.

    **Arguments:**

    - `edge`, `away`, `rest`: the points edge by edge, in order, and their distances.

    **Returns:** the length.
    """
    same = edge[1:] == edge[:-1]
    spacing = float(np.mean(np.linalg.norm(np.diff(away, axis=0), axis=1)[same]))
    total, lag = 1.0, 1
    while lag < 50:
        pair = edge[lag:] == edge[:-lag]
        if np.sum(pair) < 20:
            break
        here, there = rest[lag:][pair], rest[:-lag][pair]
        share = np.sum(here * there) / np.sqrt(np.sum(here**2) * np.sum(there**2) + 1e-300)
        if share <= 0.05:
            break
        total, lag = total + 2 * share, lag + 1
    return total * spacing
