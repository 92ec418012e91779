"""The connectivity of a tissue: a trivalent half-edge mesh."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vertax._base.half_edges import clockwise, counter_clockwise, source
from vertax._base.indexing import take
from vertax._base.tracing import compiled_property, is_concrete
from vertax.mesh._topology_checks import check_half_edge_arrays


# Every vertex joins exactly three edges, so half-edge h = 3 v + k is the k-th edge leaving vertex v in
# counter-clockwise order, and no table of sources is needed. The involution `twin` is the connectivity:
#
#     source(h) = h // 3,   target(h) = twin[h] // 3,   next(h) = one slot clockwise of twin[h].
#
#              \ cell[a] = V /                A half-edge also names a *corner*: the wedge between it
#               a           b                 and the following slot of its vertex, which belongs to
#                \         /                  the cell on its left. `cell` and `frame` are stored there.
#                 v = h//3
#      cell[h] = L | h     R = cell[b]        In a periodic tissue the corners of a cell lie in different
#                  v                          images of the box. `frame[h]` says which: the corner sits at
#                                             vertices[v] + frame[h] @ lattice, in one frame per cell.
#
# Offsets of edges follow from the frames (offset(h) = frame[next(h)] - frame[h]), so they sum to zero
# around every cell by construction, also for a cell that spans half the box and more.
#
# In a free tissue the exterior is one more face, so that vertices on the outline are trivalent too. Its
# half-edges have the label n_cells, which `segment_sum` over cells drops because it is out of range.
#
# A tissue may have a capacity for more cells than it has. A cell adds two vertices and three edges, so a
# spare slot is a separate component of two vertices joined by three edges, with the label n_cells + 1 on its
# half-edges. So arrays keep their sizes when cells are created or removed.
class Topology(eqx.Module):
    """The connectivity of a tissue: a trivalent half-edge rotation system.

    Half-edge `h` leaves vertex `h // 3`; the three half-edges of a vertex are in counter-clockwise
    order. Labels of cells and edges survive T1 transitions, so that per-cell and per-edge parameters
    stay with their cell and edge.

    **Arguments:**

    - `twin`, shape `(halfedges,)`: the half-edge in the opposite direction, an involution without fixed
        points.
    - `cell`, shape `(halfedges,)`: the cell on the left of each half-edge, `0 … n_cells - 1`;
        `n_cells` for the exterior.
    - `frame`, shape `(halfedges, 2)`: integer lattice image of each half-edge's source, in the frame of
        the cell on its left. Zero in a free tissue.
    - `edge`, shape `(halfedges,)`: an edge number for each half-edge, shared with its twin. By default
        numbered in the order of the half-edges.
    - `exterior`: whether the mesh has an exterior, as free tissues do.
    - `spare`: whether the mesh may have spare slots for new cells: pairs of vertices joined by three edges,
        with the label `n_cells + 1` on their half-edges. `n_cells` is then the capacity.

    **Raises:**

    - `ValueError` with the violated invariant (see [`Topology.validate`][vertax.Topology.validate]),
        for concrete arrays; inside `jax.jit` and `jax.vmap` only shapes and types are checked.
    """

    twin: Int[Array, " halfedges"]
    cell: Int[Array, " halfedges"]
    frame: Int[Array, "halfedges 2"]
    edge: Int[Array, " halfedges"]
    half_edge: Int[Array, " edges"]
    """One half-edge of each edge, which gives the edge its direction; the exterior is never on its left."""
    n_cells: int = eqx.field(static=True)
    """Number of cells without the exterior; with spare slots, the capacity."""
    exterior: bool = eqx.field(static=True)
    """Whether there is an exterior."""
    spare: bool = eqx.field(static=True)
    """Whether there may be spare slots."""

    def __init__(
        self,
        twin: ArrayLike,
        cell: ArrayLike,
        frame: ArrayLike,
        edge: ArrayLike | None = None,
        *,
        exterior: bool = False,
        spare: bool = False,
    ):
        concrete = all(is_concrete(x) for x in (twin, cell, frame, edge))
        xp = np if concrete else jnp
        twin, cell, frame = (xp.asarray(x) for x in (twin, cell, frame))
        check_half_edge_arrays(twin, cell, frame, concrete=concrete)
        h = xp.arange(twin.size)
        if edge is None:
            edge = (xp.cumsum(h < twin) - 1)[xp.minimum(h, twin)]
        edge = xp.asarray(edge)
        n_edges = twin.size // 2
        outside = edge.min() < 0 or edge.max() >= n_edges if concrete and edge.size else False
        if edge.shape != twin.shape or edge.dtype.kind not in "iu" or outside:
            raise ValueError(
                "Argument `edge` must give each half-edge a number in 0 … n_edges - 1."
            )
        # The first half-edge of each edge gives it its direction.
        half_edge = xp.zeros(n_edges, int)
        if concrete:
            half_edge[edge[::-1]] = h[::-1]
        else:
            half_edge = jnp.full(n_edges, twin.size).at[edge].min(h)
        # By Euler's formula a trivalent mesh has V/2 faces on a torus and V/2 + 2 on a sphere.
        n_cells = twin.size // 6 + exterior
        if concrete and not spare:
            n_cells = int(cell.max()) + (not exterior)
        half_edge = xp.where(cell[half_edge] == n_cells, twin[half_edge], half_edge)
        # (Concrete arrays are converted by NumPy, because JAX would compile for each size.)
        to_int32 = lambda x: jnp.asarray(xp.asarray(x, np.int32))
        self.twin = to_int32(twin)
        self.cell = to_int32(cell)
        self.frame = to_int32(frame)
        self.edge = to_int32(edge)
        self.half_edge = to_int32(half_edge)
        self.n_cells = n_cells
        self.exterior = exterior
        self.spare = spare
        if concrete:
            self.validate()

    @property
    def n_half_edges(self) -> int:
        """Number of half-edges."""
        return self.twin.shape[-1]

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return self.n_half_edges // 3

    @property
    def n_edges(self) -> int:
        """Number of edges."""
        return self.n_half_edges // 2

    @property
    def n_faces(self) -> int:
        """Number of labels of half-edges: cells, the exterior and the label of spare slots."""
        return self.n_cells + (2 if self.spare else self.exterior)

    @property
    def spare_label(self) -> int:
        """The label of the half-edges of spare slots."""
        return self.n_cells + 1

    @compiled_property
    def alive(self) -> Bool[Array, " cells"]:
        """Which cells exist; the others are spare slots."""
        return self.neighbour_counts > 0

    @property
    def alive_vertices(self) -> Bool[Array, " vertices"]:
        """Which vertices are not in a spare slot."""
        return self.cell.reshape(-1, 3)[:, 0] != self.spare_label

    @property
    def alive_edges(self) -> Bool[Array, " edges"]:
        """Which edges are not in a spare slot."""
        return take(self.cell, self.half_edge) != self.spare_label

    @compiled_property
    def source(self) -> Int[Array, " halfedges"]:
        """Vertex that each half-edge leaves."""
        return source(jnp.arange(self.n_half_edges, dtype=self.twin.dtype))

    @compiled_property
    def target(self) -> Int[Array, " halfedges"]:
        """Vertex to which each half-edge leads."""
        return source(self.twin)

    @compiled_property
    def next(self) -> Int[Array, " halfedges"]:
        """Following half-edge, counter-clockwise around the cell on the left."""
        return clockwise(self.twin)

    @compiled_property
    def previous(self) -> Int[Array, " halfedges"]:
        """Preceding half-edge around the cell on the left."""
        half_edges = jnp.arange(self.n_half_edges, dtype=self.twin.dtype)
        return take(self.twin, counter_clockwise(half_edges))

    @compiled_property
    def offset(self) -> Int[Array, "halfedges 2"]:
        """Lattice image of each half-edge's target, relative to its source."""
        return take(self.frame, self.next) - self.frame

    @compiled_property
    def edge_vertices(self) -> Int[Array, "edges 2"]:
        """The first and the second vertex of each edge."""
        return source(jnp.stack([self.half_edge, take(self.twin, self.half_edge)], axis=-1))

    @compiled_property
    def edge_cells(self) -> Int[Array, "edges 2"]:
        """The cells on the left and on the right of each edge (`n_cells` for the exterior)."""
        h = self.half_edge
        return jnp.stack([take(self.cell, h), take(self.cell, take(self.twin, h))], axis=-1)

    @compiled_property
    def forward(self) -> Bool[Array, " halfedges"]:
        """Which half-edges have the direction of their edge."""
        half_edges = jnp.arange(self.n_half_edges, dtype=self.twin.dtype)
        return take(self.half_edge, self.edge) == half_edges

    @compiled_property
    def on_outline(self) -> Bool[Array, " edges"]:
        """Which edges have the exterior on one side."""
        return take(self.cell, take(self.twin, self.half_edge)) == self.n_cells

    @compiled_property
    def neighbour_counts(self) -> Int[Array, " cells"]:
        """Number of sides of each cell."""
        ones = jnp.ones_like(self.cell)
        return jax.ops.segment_sum(ones, self.cell, self.n_cells)

    def validate(self) -> None:
        """Check every invariant of the mesh, on concrete arrays.

        **Raises:**

        - `ValueError` with the violated invariant: `twin` is an involution, labels of cells and edges are
            consistent, each cell is one face with enough sides, lattice frames are consistent, the tissue
            is connected and has the right genus.
        """
        twin, cell, frame, edge, half_edge = (
            np.asarray(x) for x in (self.twin, self.cell, self.frame, self.edge, self.half_edge)
        )
        n_half, n_faces = twin.size, self.n_faces
        h = np.arange(n_half)

        def require(condition: np.ndarray | bool, invariant: str):
            if not np.all(condition):
                violations = np.flatnonzero(~np.atleast_1d(condition))[:3].tolist()
                raise ValueError(
                    f"The topology is broken: {invariant} (first violations: {violations})."
                )

        require(cell.shape == (n_half,), "`cell` must have one entry a half-edge")
        require(frame.shape == (n_half, 2), "`frame` must have two entries a half-edge")
        require(edge.shape == (n_half,), "`edge` must have one entry a half-edge")
        require(half_edge.shape == (n_half // 2,), "`half_edge` must have one entry an edge")
        require(0 < n_faces <= n_half, "there must be cells, and no more than half-edges")
        is_spare = cell == self.spare_label if self.spare else np.zeros(n_half, bool)
        for name, index, bound, at in (
            ("twin", twin, n_half, "half-edges"),
            ("edge", edge, n_half // 2, "half-edges"),
            ("half_edge", half_edge, n_half, "edges"),
        ):
            require(
                (index >= 0) & (index < bound), f"`{name}` must lie in 0 … {bound - 1}, at {at}"
            )
        require(twin[twin] == h, "`twin` must be an involution, twin[twin[h]] == h, at half-edges")
        require(twin != h, "no half-edge may be its own twin, at half-edges")
        require(
            edge[twin] == edge, "a half-edge and its twin must carry one edge number, at half-edges"
        )
        require(
            np.bincount(edge, minlength=n_half // 2) == 2,
            "each edge must have two half-edges, at edges",
        )
        require(
            edge[half_edge] == np.arange(n_half // 2),
            "`half_edge` must point into its edge, at edges",
        )
        inside = (cell >= 0) & (cell < self.n_cells + self.exterior)
        require(inside | is_spare, "`cell` must lie in 0 … n_cells - 1, at half-edges")
        sides = np.bincount(cell[~is_spare], minlength=n_faces)[: self.n_cells + self.exterior]
        may_be_spare = (np.arange(sides.size) < self.n_cells) & self.spare
        require((sides > 0) | may_be_spare, "every cell must have half-edges, at cells")

        following = np.where(twin % 3 == 0, twin + 2, twin - 1)
        require(cell[following] == cell, "`cell` must be the same all around a face, at half-edges")
        closed = following[following] == h
        require(
            ~is_spare | closed,
            "a spare slot must be two vertices joined by three edges, at half-edges",
        )
        n_orbits, face = connected_components(
            coo_array((np.ones(n_half, bool), (h, following)), shape=(n_half, n_half)),
            directed=False,
        )
        labels = cell[np.unique(face, return_index=True)[1]]
        faces_of_cell = np.bincount(labels, minlength=sides.size)[: sides.size]
        require((faces_of_cell == 1) | (sides == 0), "every cell must be one face, at cells")
        # A side on the outline may be an arc, so a cell there may have two sides.
        outside = np.bincount(cell, cell[twin] == self.n_cells, n_faces)[: sides.size] > 0
        outside[self.n_cells :] = True
        require(
            (sides >= np.where(outside, 2, 3)) | (sides == 0),
            "every cell must have at least three sides, or two on the outline, at cells",
        )

        offset = frame[following] - frame
        require(
            np.all(offset[twin] == -offset, axis=1),
            "`frame` must give a half-edge and its twin opposite lattice offsets, at half-edges",
        )
        n_vertices = n_half // 3
        n_pieces, _ = connected_components(
            coo_array((np.ones(n_half, bool), (h // 3, twin // 3)), shape=(n_vertices, n_vertices)),
            directed=False,
        )
        n_spare = int(np.count_nonzero(is_spare)) // 6
        require(n_pieces - n_spare == 1, "the tissue must be in one piece")
        euler = n_vertices - n_half // 2 + n_orbits - 2 * n_spare  # each spare slot is a sphere
        if self.exterior:
            require(
                euler == 2,
                f"vertices - edges + cells must be 1 for a free tissue, but is {euler - 1}",
            )
            require(np.all(frame == 0, axis=1), "`frame` must be 0 in a free tissue, at half-edges")
            require(
                (cell[twin] != cell) | is_spare, "an edge must lie between two faces, at half-edges"
            )
            require(
                cell[half_edge] != self.n_cells,
                "the exterior must not be on the left of an edge, at edges",
            )
        else:
            require(
                euler == 0,
                f"vertices - edges + cells must be 0 for a periodic tissue, but is {euler}",
            )


def edge_neighbourhood(
    topology: Topology, edges: Int[Array, " edges"] | None = None
) -> tuple[Int[Array, " edges"], ...]:
    """The twin `t` of the half-edge of each edge, and the four half-edges `a, b, c, d` next to the edge.

    In counter-clockwise order `a`, `b` leave the source of the edge and `c`, `d` its target. `edges` selects
    edges; by default all.
    """
    h = topology.half_edge if edges is None else take(topology.half_edge, edges)
    t = take(topology.twin, h)
    return t, counter_clockwise(h), clockwise(h), counter_clockwise(t), clockwise(t)
