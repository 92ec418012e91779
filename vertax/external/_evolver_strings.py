"""Tissues as Surface Evolver knows them: points, and straight strings between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.external._simulator import Edges, SimulatorError
from vertax.mesh import Periodic, Tissue
from vertax.mesh._arcs import LARGEST_FREE_ANGLE, angle_of_area


# An arc is a chain of n straight strings of the same length between points on a circle. Such a chain is at
# rest exactly where an arc is: the tension pulls at each point as the pressures on both sides push. Over a
# chord c, with the angle α' between it and the circle, the radius is R = c / (2 sin α'), and it encloses
#
#     S = R² (n sin(2 α'/n) - sin 2 α') / 2.
#
# The angle of an arc of a tissue means the area that it encloses: S is c² g(α), with α a little below α'.
class Strings(NamedTuple):
    """A tissue as points and straight strings between them; in a periodic one, in the home box."""

    points: Float[np.ndarray, "points 2"]
    """First the vertices, then those inside of chains, edge by edge."""
    pieces: Edges
    """The strings, seen from these points, edge by edge."""
    edge: Int[np.ndarray, " pieces"]
    """Of which edge each is."""
    parts: Int[np.ndarray, " edges"]
    """How many strings each edge has."""
    wraps: Int[np.ndarray, "pieces 2"]
    """How often each goes around the box."""
    images: Int[np.ndarray, "vertices 2"]
    """In which image of the box each vertex is."""
    lattice: Float[np.ndarray, "2 2"]
    periodic: bool
    softening: float
    fixed: Int[np.ndarray, " _"]

    @classmethod
    def of(cls, tissue: Tissue, n: int = 8) -> Strings:
        """Those of a tissue, with `n` for each arc."""
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
                "An edge is longer than the periodic box, which Surface Evolver's datafiles cannot say."
            )
        home = vertices - images @ lattice
        shifts = edges.shifts + (images[first] @ lattice)[:, None]
        edges = edges._replace(across=wraps @ lattice, shifts=shifts)
        parts = np.ones(len(edges.ends), int)
        inner = np.zeros((0, 2))
        if tissue.arcs is not None:
            is_arc = (edges.cells == edges.n_cells).any(axis=1) | tissue.arcs.inner
            parts[is_arc] = n
            angles = np.asarray(tissue.arcs.angles, float)[is_arc]
            inner = _between(home[first[is_arc]], edges.vectors(home)[is_arc], angles, n)
        pinned = () if tissue.pinned is None else np.flatnonzero(np.asarray(tissue.pinned))
        pieces, edge = _pieces(edges, parts, len(vertices))
        ends = np.cumsum(parts) - 1
        around = np.zeros((len(edge), 2), int)
        around[ends] = wraps
        return cls(
            points=np.concatenate([home, inner.reshape(-1, 2)]),
            pieces=pieces,
            edge=edge,
            parts=parts,
            wraps=around,
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
        chords, bulges, _ = self._bulges(points)
        enclosed = bulges / np.sum(chords**2, axis=1)
        angles = angle_of_area(bulges, np.hypot(*chords.T))
        for _ in range(2):  # the first guess is exact to half of its digits
            angles = angles - (_enclosed(angles) - enclosed) / _enclosed_slope(angles)
        return angles

    def pulls(
        self,
        forces: Float[np.ndarray, "vertices 2"] | None,
        torques: Float[np.ndarray, " edges"] | None,
    ) -> Float[np.ndarray, "points 2"]:
        """Forces on all points that do the same, near these points, as some on vertices and angles."""
        pulls = np.zeros_like(self.points)
        if forces is not None:
            pulls[: self.n_vertices] = forces
        if torques is None:
            return pulls
        # From S = c² g(α) follows dα = (dS - 2 g c dc) / (c² g').
        chords, bulges, vectors = self._bulges(self.points)
        squared = np.sum(chords**2, axis=1)
        slope = _enclosed_slope(self.angles(self.points))
        share = np.where(self.chains, torques, 0) / (squared * slope)
        # S is half the sum of cross(p, next p), with places p counted from the first end.
        places = self._places(self.points)
        turned = lambda x: np.stack([x[:, 1], -x[:, 0]], axis=-1)
        shares, (tail, head) = share[self.edge], self.pieces.ends.T
        starts = np.cumsum(self.parts) - self.parts
        np.add.at(pulls, head, -0.5 * shares[:, None] * turned(places))
        np.add.at(pulls, tail, 0.5 * shares[:, None] * turned(places + vectors))
        by_chord = (2 * share * bulges / squared)[:, None] * chords
        first, last = tail[starts], head[starts + self.parts - 1]
        np.add.at(pulls, last, -by_chord)
        # The first end takes what the others leave.
        total = np.zeros_like(chords)
        np.add.at(
            total, self.edge, 0.5 * shares[:, None] * (turned(places + vectors) - turned(places))
        )
        np.add.at(pulls, first, by_chord - total)
        return pulls

    def _bulges(self, points: Float[np.ndarray, "points 2"]) -> tuple[np.ndarray, ...]:
        """Chords of edges, what they enclose to the right of these, and the vectors of pieces."""
        vectors, places = self.pieces.vectors(points), self._places(points)
        chords = np.stack([np.bincount(self.edge, v) for v in vectors.T], axis=-1)
        cross = places[:, 0] * vectors[:, 1] - places[:, 1] * vectors[:, 0]
        return chords, 0.5 * np.bincount(self.edge, cross), vectors

    def _places(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "pieces 2"]:
        """Where each piece begins, seen from the beginning of its edge."""
        tail = self.pieces.ends[:, 0]
        starts = np.cumsum(self.parts) - self.parts
        return points[tail] - points[tail[starts]][self.edge]

    def _piece_lengths(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " pieces"]:
        squared = np.sum(self.pieces.vectors(points) ** 2, axis=1)
        return np.sqrt(squared + (self.softening / self.parts[self.edge]) ** 2)


def _pieces(
    edges: Edges, parts: Int[np.ndarray, " edges"], n_vertices: int
) -> tuple[Edges, Int[np.ndarray, " pieces"]]:
    """Edges in pieces, and of which edge each is."""
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


def _between(
    start: Float[np.ndarray, "arcs 2"],
    chord: Float[np.ndarray, "arcs 2"],
    angle: Float[np.ndarray, " arcs"],
    n: int,
) -> Float[np.ndarray, "arcs inner 2"]:
    """The points inside of chains of `n` equal pieces that enclose what arcs do."""
    a = np.minimum(np.abs(angle), LARGEST_FREE_ANGLE)
    wanted = _enclosed(a)
    low, high = a, np.minimum(1.5 * a, 0.999 * np.pi)
    for _ in range(54):
        middle = 0.5 * (low + high)
        more = _enclosed(middle, n) < wanted
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    a = (np.sign(angle) * low)[:, None]
    # In units of half the chord, from its middle: sin(α s) / sin α along it, and as far to its right as
    # (cos(α s) - cos α) / sin α.
    s = (2 * np.arange(1, n) / n - 1)[None, :]
    flat = np.abs(a) < 1e-8
    b = np.where(flat, 1, a)
    along = np.where(flat, s, np.sin(b * s) / np.sin(b))
    rise = 2 * np.sin(0.5 * b * (1 + s)) * np.sin(0.5 * b * (1 - s)) / np.sin(b)
    aside = np.where(flat, 0.5 * a * (1 - s**2), rise)
    half = 0.5 * chord[:, None, :]
    right = np.stack([half[..., 1], -half[..., 0]], axis=-1)
    return start[:, None, :] + half + along[..., None] * half + aside[..., None] * right


def _enclosed(a: Float[np.ndarray, " arcs"], n: int | None = None) -> Float[np.ndarray, " arcs"]:
    """What a chain on a circle, or the circle, encloses over its chord, by the square of the chord."""
    area = _beyond_sine(2 * a)
    if n is not None:
        area = area - n * _beyond_sine(2 * a / n)
    straight = a == 0
    return np.where(straight, 0, area / (8 * np.sin(np.where(straight, 1, a)) ** 2))


def _enclosed_slope(a: Float[np.ndarray, " arcs"]) -> Float[np.ndarray, " arcs"]:
    """Its derivative, of the circle."""
    straight = np.abs(a) < 1e-8
    tangent = np.tan(np.where(straight, 1, a))
    return np.where(straight, 1 / 6, 0.5 - 2 * _enclosed(a) / tangent)


def _beyond_sine(x: Float[np.ndarray, " arcs"]) -> Float[np.ndarray, " arcs"]:
    """x - sin(x), to all digits."""
    squared = np.where(np.abs(x) < 1, x, 0) ** 2
    total = np.zeros_like(x)
    for k in range(19, 1, -2):  # x³/3! - x⁵/5! + …
        total = squared / (k * (k - 1)) * (1 - total) if k > 3 else (1 - total) / 6
    return np.where(np.abs(x) < 1, x**3 * total, x - np.sin(x))
