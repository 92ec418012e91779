"""Outlines of cells as polygons, for drawing."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax._base.checks import check_integer
from vertax._base.indexing import take
from vertax.mesh._boundary import Periodic
from vertax.mesh._padding import pad
from vertax.mesh._tissue import Tissue

_POINTS_PER_ARC = 24


class Drawing(eqx.Module):
    """The geometry for drawing a tissue; the centroid of each cell is in the home box.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `points_per_arc`: number of straight pieces of an arc.
    - `near`: if given, each periodic cell is drawn in the image nearest to this point instead of in the home
        box. In an animation these are the centroids of the last frame.
    """

    lines: Float[np.ndarray, "halfedges points 2"]
    """Each half-edge from its source to its target, in the image in which the cell on its left is drawn."""
    image: Int[np.ndarray, "halfedges 2"]
    """Lattice image of the source of each half-edge in `lines`."""
    cell: Int[np.ndarray, " halfedges"]
    following: Int[np.ndarray, " halfedges"]
    twin: Int[np.ndarray, " halfedges"]
    half_edge: Int[np.ndarray, " edges"]
    edge: Int[np.ndarray, " halfedges"]
    n_cells: int
    n_edges: int
    alive: Bool[np.ndarray, " cells"]
    """Which cells exist; spare slots have no corners."""
    alive_edges: Bool[np.ndarray, " edges"]
    centroids: Float[np.ndarray, "cells 2"]
    """Centroids of the drawn cells; NaN for spare slots."""
    cell_size: float
    """Square root of the mean area."""
    box: Float[np.ndarray, "5 2"] | None
    """Closed outline of the periodic box; None for a free tissue."""
    lattice: Float[np.ndarray, "2 2"] | None
    """Lattice vectors of the periodic box; None for a free tissue."""

    def __init__(
        self,
        tissue: Tissue,
        points_per_arc: int = _POINTS_PER_ARC,
        near: Float[np.ndarray, "cells 2"] | None = None,
    ):
        m = tissue.topology
        sizes = (m.n_half_edges, m.n_cells, m.n_cells, m.n_half_edges, m.n_cells, m.n_edges)
        # (Padded, so that tissues of similar size share the compiled function.)
        parts = zip(_geometry(pad(tissue), points_per_arc), sizes, strict=True)
        lines, centroids, areas, following, *alive = (np.asarray(x)[:n] for x, n in parts)
        image = np.zeros((m.n_faces, 2), int)
        shift = np.zeros((m.n_faces, 2))
        self.box = self.lattice = None
        if isinstance(tissue.boundary, Periodic):
            self.lattice = lattice = np.asarray(tissue.boundary.lattice, float)
            fractions = centroids.astype(float) @ np.linalg.inv(lattice)
            # The margin prevents that rounding moves a centroid on the boundary of the box (as in a regular
            # lattice) to the opposite side. A cell of area 0 has no centroid and is not shifted.
            fractions = np.nan_to_num(fractions, posinf=0, neginf=0)
            image[: tissue.n_cells] = -np.floor(fractions + 1e-6).astype(int)
            if near is not None:
                # New cells have no point in `near` and are in the home box.
                old = np.flatnonzero(np.isfinite(near).all(axis=1))
                image[old] = np.rint(near[old] @ np.linalg.inv(lattice) - fractions[old])
            shift = image @ lattice
            first, second = lattice
            self.box = np.stack([0 * first, first, first + second, second, 0 * first])
        self.cell = np.asarray(m.cell)
        self.lines = lines.astype(float) + shift[self.cell][:, None]
        self.image = np.asarray(m.frame) + image[self.cell]
        self.n_cells = tissue.n_cells
        self.n_edges = tissue.n_edges
        self.alive, self.alive_edges = alive
        self.centroids = centroids.astype(float) + shift[: tissue.n_cells]
        self.centroids[~self.alive] = np.nan
        self.following = following
        self.twin = np.asarray(m.twin)
        self.half_edge = np.asarray(m.half_edge)
        self.edge = np.asarray(m.edge)
        self.cell_size = float(np.sqrt(np.mean(np.abs(areas.astype(float)[self.alive]))))

    def polygons(self) -> tuple[Float[np.ndarray, "cells sides 2"], Int[np.ndarray, " cells"]]:
        """Corners of all cells and their numbers of corners, see `cell_polygons`."""
        n_points = self.lines.shape[1] - 1
        sides = np.bincount(self.cell, minlength=self.n_cells)[: self.n_cells]
        # The first half-edge of each cell; 0 for spare slots.
        cells, first = np.unique(self.cell, return_index=True)
        half_edge = np.zeros(self.n_cells, int)
        half_edge[cells[cells < self.n_cells]] = first[cells < self.n_cells]
        polygons = np.repeat(self.lines[half_edge, :1], n_points * sides.max(), axis=1)
        # All cells at once, one side at a time.
        for k in range(sides.max()):
            has_side = k < sides
            side = slice(k * n_points, (k + 1) * n_points)
            polygons[has_side, side] = self.lines[half_edge[has_side], :-1]
            half_edge = self.following[half_edge]
        return polygons, n_points * sides

    def sides(
        self, mask: Bool[np.ndarray, " cells"]
    ) -> tuple[Float[np.ndarray, "lines points 2"], Int[np.ndarray, " lines"]]:
        """Lines that draw each side of the marked cells once, and the edge of each line.

        An edge between two cells that are drawn next to each other is one line; an edge across the
        periodic boundary is two lines, one at each cell.
        """
        mask = np.append(mask & self.alive, [False, False])  # the exterior and spare slots
        first, second = self.half_edge, self.twin[self.half_edge]
        # Both cells of an edge draw it in the same place if its first vertex has the same image in both.
        apart = np.any(self.image[first] != self.image[self.following[second]], axis=1)
        left, right = mask[self.cell[first]], mask[self.cell[second]]
        drawn = np.concatenate([first[left], second[right & (apart | ~left)]])
        return self.lines[drawn], self.edge[drawn]


def cell_polygons(
    tissue: Tissue, points_per_arc: int = _POINTS_PER_ARC
) -> tuple[Float[np.ndarray, "cells sides 2"], Int[np.ndarray, " cells"]]:
    """Corners of all cells, counter-clockwise.

    In a periodic tissue the centroid of each cell is in the home box; its corners may be outside. In a
    tissue with arcs, each side is a line of `points_per_arc` pieces.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `points_per_arc`: number of straight pieces of an arc.

    **Returns:** the corners, in units of length, where the rows of cells with fewer corners are padded with
    their first corner; and the number of corners of each cell, 0 for spare slots.

    **Raises:**

    - `ValueError` if `points_per_arc` is not positive.
    """
    check_integer("points_per_arc", points_per_arc, at_least=1)
    return Drawing(tissue, points_per_arc).polygons()


@eqx.filter_jit  # one compilation instead of one for each operation
def _geometry(tissue: Tissue, points_per_arc: int) -> tuple[Array, ...]:
    m = tissue.topology
    fractions = jnp.linspace(0, 1, 2 if tissue.angles is None else points_per_arc + 1)
    points = take(tissue.edge_points(fractions.astype(tissue.vertices.dtype)), m.edge)
    points = jnp.where(m.forward[:, None, None], points, points[:, ::-1])
    # (In this order a line starts exactly at its corner: files keep vertices to the last bit.)
    lines = tissue.corners[:, None] + (points - points[:, :1])
    return lines, tissue.centroids, tissue.areas, m.next, tissue.alive, m.alive_edges
