"""Tissues in the string model of Surface Evolver: points, and straight strings between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax._base.arcs import LARGEST_FREE_ANGLE
from vertax.external._simulator import Edges, SimulatorError
from vertax.mesh import Periodic, Tissue, angle_of_area


# An arc is a chain of n straight strings of equal length between points on a circle. Such a chain is at rest
# under the same tension and pressure difference as an arc. With the chord c and the angle α' between chord
# and circle, the radius is R = c / (2 sin α'), and the area between chain and chord is
#
#     S = R² (n sin(2 α'/n) - sin 2 α') / 2.
#
# The angle α of the arc of a tissue is defined by the same area: S = c² g(α), with α slightly below α'.
class Strings(NamedTuple):
    """A tissue as points and straight strings between them; periodic tissues are wrapped into the box."""

    points: Float[np.ndarray, "points 2"]
    """The vertices, followed by the inner points of chains, edge by edge."""
    pieces: Edges
    """The strings between these points, edge by edge."""
    edge: Int[np.ndarray, " pieces"]
    """Index of the edge of each string."""
    parts: Int[np.ndarray, " edges"]
    """Number of strings of each edge."""
    wraps: Int[np.ndarray, "pieces 2"]
    """Number of periods that each string crosses."""
    images: Int[np.ndarray, "vertices 2"]
    """Indices of the image of the box that each vertex was in."""
    lattice: Float[np.ndarray, "2 2"]
    periodic: bool
    softening: float
    fixed: Int[np.ndarray, " _"]

    @classmethod
    def of(cls, tissue: Tissue, n: int = 8) -> Strings:
        """Convert a tissue, with `n` strings per arc."""
        edges = Edges.of(tissue)
        vertices = np.asarray(tissue.vertices, float)
        lattice = np.zeros((2, 2))
        images = np.zeros(vertices.shape, int)
        across = np.zeros(edges.ends.shape, int)
        periodic = isinstance(tissue.boundary, Periodic)
        if isinstance(tissue.boundary, Periodic):
            lattice = np.asarray(tissue.boundary.lattice, float)
            images = np.floor(vertices @ np.linalg.inv(lattice)).astype(int)
            across = np.rint(edges.across @ np.linalg.inv(lattice)).astype(int)
        first, last = edges.ends.T
        wraps = across + images[last] - images[first]
        if np.abs(wraps).max(initial=0) > 1:
            raise SimulatorError(
                "An edge is longer than the periodic box, which Surface Evolver's datafiles cannot represent."
            )
        wrapped = vertices - images @ lattice
        shifts = edges.shifts + (images[first] @ lattice)[:, None]
        edges = edges._replace(across=wraps @ lattice, shifts=shifts)
        parts = np.ones(len(edges.ends), int)
        inner = np.zeros((0, 2))
        if tissue.arcs is not None:
            is_arc = (edges.cells == edges.n_cells).any(axis=1) | tissue.arcs.inner
            parts[is_arc] = n
            angles = np.asarray(tissue.arcs.angles, float)[is_arc]
            inner = _chain_points(wrapped[first[is_arc]], edges.vectors(wrapped)[is_arc], angles, n)
        pinned = () if tissue.pinned is None else np.flatnonzero(np.asarray(tissue.pinned))
        pieces, edge = _pieces(edges, parts, len(vertices))
        ends = np.cumsum(parts) - 1
        piece_wraps = np.zeros((len(edge), 2), int)
        piece_wraps[ends] = wraps
        return cls(
            points=np.concatenate([wrapped, inner.reshape(-1, 2)]),
            pieces=pieces,
            edge=edge,
            parts=parts,
            wraps=piece_wraps,
            images=images,
            lattice=lattice,
            periodic=periodic,
            softening=float(np.asarray(tissue.softening)),
            fixed=np.asarray(pinned, int),
        )

    @property
    def n_vertices(self) -> int:
        """Number of vertices: the first points."""
        return len(self.images)

    @property
    def chains(self) -> Bool[np.ndarray, " edges"]:
        """Which edges are chains."""
        return self.parts > 1

    def lengths(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " edges"]:
        """Length of each edge."""
        return np.bincount(self.edge, self._piece_lengths(points))

    def areas(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " cells"]:
        """Area of each cell."""
        return self.pieces.areas(points)

    def perimeters(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " cells"]:
        """Perimeter of each cell."""
        return self.pieces.sums(np.repeat(self._piece_lengths(points), 2))

    def angles(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " edges"]:
        """The angle of each edge; 0 where it is straight."""
        chords, segment_areas, _ = self._chords_and_areas(points)
        enclosed = segment_areas / np.sum(chords**2, axis=1)
        angles = angle_of_area(segment_areas, np.hypot(*chords.T))
        for _ in range(2):  # Newton steps; the first guess has half of the digits
            angles = angles - (_segment_area(angles) - enclosed) / _segment_area_derivative(angles)
        return angles

    def lines(self) -> tuple[list[str], list[str], list[str]]:
        """Lines of a datafile: its head, the points and the strings."""
        head = ["STRING", "SPACE_DIMENSION 2"]
        if self.periodic:
            head += ["TORUS", "PERIODS", *(f"{a:.17g} {b:.17g}" for a, b in self.lattice)]
        points = [f"{i} {x:.17g} {y:.17g}" for i, (x, y) in enumerate(self.points, 1)]
        for i in self.fixed:
            points[i] += " fixed"
        strings = [f"{i} {a + 1} {b + 1}" for i, (a, b) in enumerate(self.pieces.ends, 1)]
        if self.periodic:
            sign = np.array(["*", "+", "-"])[self.wraps]
            strings = [f"{line} {x} {y}" for line, (x, y) in zip(strings, sign, strict=True)]
        return head, points, strings

    def point_forces(
        self,
        forces: Float[np.ndarray, "vertices 2"] | None,
        torques: Float[np.ndarray, " edges"] | None,
    ) -> Float[np.ndarray, "points 2"]:
        """Forces on all points that do the same virtual work as forces on vertices and torques on angles."""
        point_forces = np.zeros_like(self.points)
        if forces is not None:
            point_forces[: self.n_vertices] = forces
        if torques is None:
            return point_forces
        # S = c² g(α), so dα = (dS - 2 g c dc) / (c² g').
        chords, segment_areas, vectors = self._chords_and_areas(self.points)
        squared = np.sum(chords**2, axis=1)
        slope = _segment_area_derivative(self.angles(self.points))
        coefficient = np.where(self.chains, torques, 0) / (squared * slope)
        # S = Σ p × p_next / 2, with positions p relative to the first end of the edge.
        offsets = self._offsets(self.points)
        turned = lambda x: np.stack([x[:, 1], -x[:, 0]], axis=-1)
        coefficients, (tail, head) = coefficient[self.edge], self.pieces.ends.T
        starts = np.cumsum(self.parts) - self.parts
        np.add.at(point_forces, head, -0.5 * coefficients[:, None] * turned(offsets))
        np.add.at(point_forces, tail, 0.5 * coefficients[:, None] * turned(offsets + vectors))
        by_chord = (2 * coefficient * segment_areas / squared)[:, None] * chords
        first, last = tail[starts], head[starts + self.parts - 1]
        np.add.at(point_forces, last, -by_chord)
        # The force on the first end makes the total force zero.
        total = np.zeros_like(chords)
        np.add.at(
            total,
            self.edge,
            0.5 * coefficients[:, None] * (turned(offsets + vectors) - turned(offsets)),
        )
        np.add.at(point_forces, first, by_chord - total)
        return point_forces

    def _chords_and_areas(self, points: Float[np.ndarray, "points 2"]) -> tuple[np.ndarray, ...]:
        """Chords of edges, the areas between chains and chords (on their right), and vectors of pieces."""
        vectors, offsets = self.pieces.vectors(points), self._offsets(points)
        chords = np.stack([np.bincount(self.edge, v) for v in vectors.T], axis=-1)
        cross = offsets[:, 0] * vectors[:, 1] - offsets[:, 1] * vectors[:, 0]
        return chords, 0.5 * np.bincount(self.edge, cross), vectors

    def _offsets(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "pieces 2"]:
        """The start of each piece relative to the start of its edge."""
        tail = self.pieces.ends[:, 0]
        starts = np.cumsum(self.parts) - self.parts
        return points[tail] - points[tail[starts]][self.edge]

    def _piece_lengths(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " pieces"]:
        squared = np.sum(self.pieces.vectors(points) ** 2, axis=1)
        return np.sqrt(squared + (self.softening / self.parts[self.edge]) ** 2)


def _pieces(
    edges: Edges, parts: Int[np.ndarray, " edges"], n_vertices: int
) -> tuple[Edges, Int[np.ndarray, " pieces"]]:
    """The pieces of all edges, and the index of the edge of each piece."""
    edge = np.repeat(np.arange(len(parts)), parts)
    ends = np.cumsum(parts) - 1
    starts = ends - parts + 1
    is_first, is_last = (np.isin(np.arange(len(edge)), x) for x in (starts, ends))
    tail, head = np.zeros_like(edge), np.zeros_like(edge)
    tail[is_first], head[is_last] = edges.ends.T
    between = n_vertices + np.arange(np.sum(~is_last))
    head[~is_last], tail[~is_first] = between, between
    across = np.where(is_last[:, None], edges.across[edge], 0)
    return (
        Edges(
            np.stack([tail, head], axis=-1),
            across,
            edges.cells[edge],
            edges.shifts[edge],
            edges.n_cells,
        ),
        edge,
    )


def _chain_points(
    start: Float[np.ndarray, "arcs 2"],
    chord: Float[np.ndarray, "arcs 2"],
    angle: Float[np.ndarray, " arcs"],
    n: int,
) -> Float[np.ndarray, "arcs inner 2"]:
    """The inner points of chains of `n` equal pieces that enclose the same areas as arcs."""
    a = np.minimum(np.abs(angle), LARGEST_FREE_ANGLE)
    target = _segment_area(a)
    low, high = a, np.minimum(1.5 * a, 0.999 * np.pi)
    for _ in range(54):
        middle = 0.5 * (low + high)
        below = _segment_area(middle, n) < target
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    a = (np.sign(angle) * low)[:, None]
    # In units of half the chord, relative to its midpoint: sin(α s) / sin α along the chord, and
    # (cos(α s) - cos α) / sin α to its right.
    s = (2 * np.arange(1, n) / n - 1)[None, :]
    is_straight = np.abs(a) < 1e-8
    b = np.where(is_straight, 1, a)
    along = np.where(is_straight, s, np.sin(b * s) / np.sin(b))
    rise = 2 * np.sin(0.5 * b * (1 + s)) * np.sin(0.5 * b * (1 - s)) / np.sin(b)
    across = np.where(is_straight, 0.5 * a * (1 - s**2), rise)
    half = 0.5 * chord[:, None, :]
    right = np.stack([half[..., 1], -half[..., 0]], axis=-1)
    return start[:, None, :] + half + along[..., None] * half + across[..., None] * right


def _segment_area(
    a: Float[np.ndarray, " arcs"], n: int | None = None
) -> Float[np.ndarray, " arcs"]:
    """The area between the chord and a circular arc, or a chain of n pieces on it, per chord squared."""
    area = _x_minus_sin(2 * a)
    if n is not None:
        area = area - n * _x_minus_sin(2 * a / n)
    straight = a == 0
    return np.where(straight, 0, area / (8 * np.sin(np.where(straight, 1, a)) ** 2))


def _segment_area_derivative(a: Float[np.ndarray, " arcs"]) -> Float[np.ndarray, " arcs"]:
    """The derivative of `_segment_area` of an arc by its angle."""
    straight = np.abs(a) < 1e-8
    tangent = np.tan(np.where(straight, 1, a))
    return np.where(straight, 1 / 6, 0.5 - 2 * _segment_area(a) / tangent)


def _x_minus_sin(x: Float[np.ndarray, " arcs"]) -> Float[np.ndarray, " arcs"]:
    """x - sin(x) without cancellation."""
    squared = np.where(np.abs(x) < 1, x, 0) ** 2
    total = np.zeros_like(x)
    for k in range(19, 1, -2):  # x³/3! - x⁵/5! + …
        total = squared / (k * (k - 1)) * (1 - total) if k > 3 else (1 - total) / 6
    return np.where(np.abs(x) < 1, x**3 * total, x - np.sin(x))
