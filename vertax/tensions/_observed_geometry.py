"""The observed geometry of a tissue as NumPy arrays: vertices, arcs and bends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.mesh import Tissue, geometry_of


class Lift(NamedTuple):
    """The map of directions and arcs of an image to the tangent planes of a surface."""

    root: Float[np.ndarray, "vertices 2 2"]
    """Root of the metric at each vertex."""
    offset: Float[np.ndarray, "vertices 3 2"]
    """Of a straight edge of space, its projection on the tangent plane less the image of its chord."""
    turn: Float[np.ndarray, "edges 2"]
    """Half of the geodesic turning of an arc: the first plus the second times its angle."""
    chord: Float[np.ndarray, " edges"]
    """Length of the chord of an arc with the length and the turning in space."""

    def turned(
        self,
        vectors: Float[np.ndarray, "junctions 3 2"],
        junctions: Int[np.ndarray, " junctions"],
        *,
        straight: bool,
    ) -> tuple[Float[np.ndarray, "junctions 3"], Float[np.ndarray, "junctions 3"]]:
        """Directions of vectors of the image in tangent planes, and their slopes by those in the image."""
        map_ = lambda x: np.einsum("vij,vlj->vli", self.root[junctions], x)
        image = map_(vectors)
        if straight:
            image = image + self.offset[junctions]
        rate = map_(np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1))
        cross = image[..., 0] * rate[..., 1] - image[..., 1] * rate[..., 0]
        squared = np.maximum(np.sum(image**2, axis=-1), 1e-300)
        return np.arctan2(image[..., 1], image[..., 0]), cross / squared


class ObservedGeometry(NamedTuple):
    """The geometry of a tissue as NumPy arrays, arcs in terms of chords and angles.

    Its unknowns are displacements of the vertices, and changes of angles and bends, in one vector.
    """

    ends: Int[np.ndarray, "edges 2"]
    cells: Int[np.ndarray, "edges 2"]
    """On the left and on the right; the exterior is the number of cells."""
    half_edge: Int[np.ndarray, "vertices 3"]
    """Edge of each of the three half-edges that leave a vertex."""
    forward: Bool[np.ndarray, "vertices 3"]
    """Whether the half-edge has the direction of its edge."""
    chord: Float[np.ndarray, "edges 2"]
    angle: Float[np.ndarray, " edges"]
    bend: Float[np.ndarray, "edges 2"]
    """Angles by which the tangents of the curve are turned from those of its arc: symmetric and antisymmetric
    part of its two ends."""
    place: Float[np.ndarray, "vertices 2"]
    """Positions of the vertices in the tissue, which distinguish neighbours from distant ones; not moved."""
    inner: Bool[np.ndarray, " vertices"]
    """Vertices where three cells meet and forces balance."""
    size: float
    """Root of the mean area of a cell."""
    lift: Lift | None = None
    """The map to a curved surface; None in the plane."""

    @property
    def places(self) -> Float[np.ndarray, "geometry 2"]:
        """Position of each unknown."""
        middle = self.place[self.ends[:, 0]] + 0.5 * self.chord
        at_edges = np.concatenate([middle, np.repeat(middle, 2, axis=0)])
        return np.concatenate([np.repeat(self.place, 2, axis=0), at_edges])

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.inner)

    def moved(self, change: Float[np.ndarray, " geometry"]) -> ObservedGeometry:
        """The geometry after a change of vertices, angles and bends."""
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


def observed_geometry(
    tissue: Tissue,
    holes: Bool[np.ndarray, " cells"] | None = None,
    closed: Bool[np.ndarray, " edges"] | None = None,
) -> ObservedGeometry:
    """The geometry of a tissue.

    **Arguments:**

    - `tissue`: the tissue.
    - `holes`: faces that are no cells: forces at their junctions are unknown, as at the outline.
    - `closed`: edges that the mask does not show: forces at their ends are unknown too.
    """
    m, geometry = tissue.topology, geometry_of(tissue)
    is_cell = np.append(np.full(tissue.n_cells, True) if holes is None else ~holes, False)
    inner = np.all(is_cell[np.asarray(m.cell)].reshape(-1, 3), axis=1)
    if closed is not None:
        inner &= ~np.any(closed[np.asarray(m.edge)].reshape(-1, 3), axis=1)
    return ObservedGeometry(
        ends=geometry.edge_vertices,
        cells=geometry.edge_cells,
        half_edge=np.asarray(m.edge).reshape(-1, 3),
        forward=geometry.forward.reshape(-1, 3),
        chord=geometry.edge_vectors,
        angle=geometry.edge_angles,
        bend=np.zeros((tissue.n_edges, 2)),
        place=np.asarray(tissue.vertices, float),
        inner=inner,
        size=float(np.sqrt(np.mean(np.abs(geometry.areas[: tissue.n_cells][is_cell[:-1]])))),
    )
