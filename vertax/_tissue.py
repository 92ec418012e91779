"""A tissue and its geometry."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from vertax._boundary import AbstractBoundary
from vertax._misc import compiled_property, is_concrete
from vertax._topology import Topology, clockwise, edge_neighbourhood, source, take


class Tissue(eqx.Module):
    r"""A planar polygonal tissue: vertices, their connectivity and the space they live in.

    Geometry is differentiable in `vertices` and in the boundary (the lattice of a periodic box).

    **Arguments:**

    - `vertices`, shape `(vertices, 2)`: positions, in units of length; they may lie outside the periodic box.
    - `topology`: the [`Topology`][vertax.Topology].
    - `boundary`: the space, e.g. [`Periodic`][vertax.Periodic].
    - `softening`: the length $\varepsilon$ below which an edge is rounded off,
        $\ell = \sqrt{|d|^2 + \varepsilon^2}$; it makes a four-fold vertex (an edge of length 0) a smooth
        point of every energy. 0 switches it off; by default $10^{-3}$ of the root mean cell area,
        which changes the length of a typical edge by parts in a million.

    **Raises:**

    - `ValueError` for positions of the wrong shape or that are not finite, or a negative softening.
    """

    vertices: Float[Array, "vertices 2"]
    topology: Topology
    boundary: AbstractBoundary
    softening: Float[Array, ""]

    def __init__(
        self,
        vertices: ArrayLike,
        topology: Topology,
        boundary: AbstractBoundary,
        softening: float | Float[Array, ""] | None = None,
    ):
        vertices = jnp.asarray(vertices, jnp.result_type(vertices, jnp.float32))
        if vertices.shape != (topology.n_vertices, 2):
            raise ValueError(
                f"Argument `vertices` must have shape ({topology.n_vertices}, 2) to match the topology, "
                f"but has {vertices.shape}."
            )
        if is_concrete(vertices) and not np.isfinite(np.asarray(vertices)).all():
            raise ValueError("Argument `vertices` must be finite, but holds NaN or infinity.")
        self.vertices = vertices
        self.topology = topology
        self.boundary = boundary
        if softening is None:
            self.softening = jnp.zeros((), vertices.dtype)
            softening = 1e-3 * jnp.sqrt(jax.lax.stop_gradient(_mean_area(self)))
        softening = jnp.asarray(softening, vertices.dtype)
        if is_concrete(softening) and not softening >= 0:
            raise ValueError(f"Argument `softening` must be at least 0, but is {softening}.")
        self.softening = softening

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.topology.n_cells

    @property
    def n_edges(self) -> int:
        """Number of edges."""
        return self.topology.n_edges

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return self.topology.n_vertices

    @compiled_property
    def neighbour_counts(self) -> Int[Array, " cells"]:
        """Number of sides of each cell."""
        return self.topology.neighbour_counts

    @compiled_property
    def edge_segments(self) -> tuple[Float[Array, "edges 2"], Float[Array, "edges 2"]]:
        """First vertex of each edge, and the edge as a vector from there across periodic boundaries."""
        m = self.topology
        twin, _, _, _, following = edge_neighbourhood(m)
        offset = take(m.frame, following) - take(m.frame, m.half_edge)
        first = take(self.vertices, source(m.half_edge))
        last = take(self.vertices, source(twin))
        return first, last + self.boundary.translation(offset) - first

    @compiled_property
    def edge_vectors(self) -> Float[Array, "edges 2"]:
        """Each edge as a vector, from its first to its second vertex across periodic boundaries."""
        return self.edge_segments[1]

    @compiled_property
    def edge_lengths(self) -> Float[Array, " edges"]:
        """Length of each edge (softened, see the class)."""
        return self._lengths(self.edge_vectors)

    @compiled_property
    def areas(self) -> Float[Array, " cells"]:
        """Signed area of each cell, positive for an upright (counter-clockwise) polygon."""
        return self._cell_sums(self._area_shares())

    @compiled_property
    def perimeters(self) -> Float[Array, " cells"]:
        """Perimeter of each cell (softened, see the class)."""
        lengths = self.edge_lengths
        return self._cell_sums((lengths, lengths))

    @compiled_property
    def shape_factors(self) -> Float[Array, " cells"]:
        r"""Observed shape factor $P/\sqrt{A}$ of each cell (Bi et al. 2015, doi:10.1038/nphys3471)."""
        return self.perimeters / jnp.sqrt(self.areas)

    @compiled_property
    def corners(self) -> Float[Array, "halfedges 2"]:
        """Source of each half-edge, in the frame of the cell on its left.

        The corners of one cell, in the order of `topology.next`, are its polygon drawn whole.
        """
        return jnp.repeat(self.vertices, 3, axis=0) + self.boundary.translation(self.topology.frame)

    @compiled_property
    def centroids(self) -> Float[Array, "cells 2"]:
        """Centre of area of each cell, in the frame of the cell."""
        # Relative to the mean corner: the polygon formula loses digits far from the origin.
        corners, cell = self.corners, self.topology.cell
        counts = self.topology.neighbour_counts[:, None].astype(corners.dtype)
        centre = jax.ops.segment_sum(corners, cell, self.n_cells) / counts
        p = corners - take(centre, cell)
        q = take(p, self.topology.next)
        twice_area = _cross(p, q)
        moment = jax.ops.segment_sum((p + q) * twice_area[:, None] / 6, cell, self.n_cells)
        return centre + moment / (jax.ops.segment_sum(twice_area, cell, self.n_cells) / 2)[:, None]

    @property
    def configuration(self) -> Float[Array, "vertices 2"]:
        """The degrees of freedom that an equilibrium relaxes."""
        return self.vertices

    def with_configuration(self, configuration: Float[Array, "vertices 2"]) -> Tissue:
        """The same tissue with its degrees of freedom replaced."""
        return eqx.tree_at(lambda t: t.vertices, self, configuration)

    def with_topology(self, topology: Topology) -> Tissue:
        """The same vertices, connected in another way."""
        return eqx.tree_at(lambda t: t.topology, self, topology)

    def _lengths(self, vectors: Float[Array, "edges 2"]) -> Float[Array, " edges"]:
        squared = vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + self.softening**2
        # An edge of length exactly 0 without softening has no direction; the inner `where` keeps the
        # derivative of the square root finite there (0, the middle of all its one-sided slopes).
        at_zero = squared == 0
        return jnp.where(at_zero, 0, jnp.sqrt(jnp.where(at_zero, 1, squared)))

    def _area_shares(self) -> tuple[Float[Array, " edges"], Float[Array, " edges"]]:
        """What each edge contributes to the areas of its left and right cell (shoelace formula)."""
        m = self.topology
        first, vector = self.edge_segments
        left = first + self.boundary.translation(take(m.frame, m.half_edge))
        # The right cell's corner at the first vertex is one slot clockwise.
        right = first + self.boundary.translation(take(m.frame, clockwise(m.half_edge)))
        return 0.5 * _cross(left, vector), -0.5 * _cross(right, vector)

    def _cell_sums(
        self, shares: tuple[Float[Array, " edges"], Float[Array, " edges"]]
    ) -> Float[Array, " cells"]:
        cells = self.topology.edge_cells
        ids = jnp.concatenate([cells[:, 0], cells[:, 1]])
        return jax.ops.segment_sum(jnp.concatenate(shares), ids, self.n_cells)


@eqx.filter_jit
def _mean_area(tissue: Tissue) -> Float[Array, ""]:
    return jnp.mean(jnp.abs(tissue.areas))


def _cross(p: Float[Array, "*n 2"], q: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
