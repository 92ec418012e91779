"""Cells as polygons, for drawing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax._boundary import Periodic
from vertax._tissue import Tissue


def cell_polygons(
    tissue: Tissue,
) -> tuple[Float[np.ndarray, "cells sides 2"], Int[np.ndarray, " cells"]]:
    """Corners of all cells, counter-clockwise, each cell whole.

    In a periodic tissue each cell is placed so that its centroid lies in the home box; its corners
    may stick out.

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].

    **Returns:** the corners, in units of length, where rows of cells with fewer sides than others
    are filled up with their first corner; and the number of sides of each cell.
    """
    m = tissue.topology
    cell, following = np.asarray(m.cell), np.asarray(m.next)
    corners = np.asarray(tissue.corners) + home_shift(tissue)[cell]
    sides = np.bincount(cell, minlength=tissue.n_cells)
    first = np.unique(cell, return_index=True)[1]
    polygons = np.repeat(corners[first][:, None], sides.max(), axis=1)
    # All cells at once, one side at a time.
    half_edge = first
    for k in range(1, sides.max()):
        half_edge = following[half_edge]
        more = k < sides
        polygons[more, k] = corners[half_edge[more]]
    return polygons, sides


def cell_sides(
    tissue: Tissue, mask: Bool[np.ndarray, " cells"]
) -> tuple[Float[np.ndarray, "segments 2 2"], Int[np.ndarray, " segments"]]:
    """Line segments that show each side of each marked cell of `cell_polygons` once.

    An edge between two cells drawn side by side is one segment; one across the periodic boundary
    shows at both cells, in two places.

    **Returns:** the two ends of each segment, and its half-edge.
    """
    m = tissue.topology
    cell, following, twin = np.asarray(m.cell), np.asarray(m.next), np.asarray(m.twin)
    image = np.asarray(m.frame) + home_image(tissue)[cell]
    corners = np.asarray(tissue.corners) + home_shift(tissue)[cell]
    segments = np.stack([corners, corners[following]], axis=1)
    half_edge = np.asarray(m.half_edge)
    other = twin[half_edge]
    # Both cells of an edge draw it in the same place if they see its first vertex in the same
    # image.
    apart = np.any(image[half_edge] != image[following[other]], axis=1)
    left, right = mask[cell[half_edge]], mask[cell[other]]
    shown = np.concatenate([half_edge[left], other[right & (apart | ~left)]])
    return segments[shown], shown


def home_image(tissue: Tissue) -> Int[np.ndarray, "cells 2"]:
    """Lattice image that takes each cell's centroid into the home box."""
    if not isinstance(tissue.boundary, Periodic):
        return np.zeros((tissue.n_cells, 2), int)
    lattice = np.asarray(tissue.boundary.lattice, float)
    fractions = np.asarray(tissue.centroids, float) @ np.linalg.inv(lattice)
    # The margin keeps a centroid on the edge of the box (a regular lattice, say) from jumping to
    # the other side by rounding. A cell of area zero has no centroid and stays where it is.
    return -np.floor(np.nan_to_num(fractions, posinf=0, neginf=0) + 1e-6).astype(int)


def home_shift(tissue: Tissue) -> Float[np.ndarray, "cells 2"]:
    """Displacement that takes each cell's centroid into the home box."""
    if not isinstance(tissue.boundary, Periodic):
        return np.zeros((tissue.n_cells, 2))
    return home_image(tissue) @ np.asarray(tissue.boundary.lattice, float)


def box_outline(tissue: Tissue) -> Float[np.ndarray, "5 2"] | None:
    """The periodic box as a closed line, or None without one."""
    if not isinstance(tissue.boundary, Periodic):
        return None
    first, second = np.asarray(tissue.boundary.lattice, float)
    origin = np.zeros(2)
    return np.stack([origin, first, first + second, second, origin])
