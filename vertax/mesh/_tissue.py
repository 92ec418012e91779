"""A tissue and its geometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from vertax._base.tracing import compiled_property, is_concrete
from vertax.mesh._arcs import Arcs, arc_points, area_factor, bounded, length_factor, moment_factor
from vertax.mesh._boundary import AbstractBoundary, Free, Periodic
from vertax.mesh._capacity import size_class, with_slots, without_slots
from vertax.mesh._edge_ends import gather_at_ends
from vertax.mesh._overlaps import Overlaps, find_overlaps
from vertax.mesh._topology import Topology, clockwise, edge_neighbourhood, source, take


class Measurements(NamedTuple):
    """What most energies ask of a tissue."""

    lengths: Float[Array, " edges"]
    areas: Float[Array, " cells"]
    perimeters: Float[Array, " cells"]


class Tissue(eqx.Module):
    r"""A planar tissue: vertices, their connectivity and the space they live in.

    Geometry is differentiable in `vertices`, in the angles of `arcs` and in the boundary (the lattice of
    a periodic box).

    Edges are straight, or circular arcs (paper, Methods, "Bounded mode"): an arc with the angle
    $\alpha$ between its chord $c$ and its tangents has the radius $R = c / (2 \sin\alpha)$ and the length
    $c\,\alpha / \sin\alpha$, and adds the area $c^2 (\alpha - \sin\alpha\cos\alpha) / (4 \sin^2\alpha)$
    to the cell on the left of its edge, which it bulges out of if $\alpha > 0$. On the outline of a
    free tissue the cell is always on the left.

    **Arguments:**

    - `vertices`, shape `(vertices, 2)`: positions, in units of length; they may lie outside the periodic box.
    - `topology`: the [`Topology`][vertax.Topology].
    - `boundary`: the space, [`Periodic`][vertax.Periodic] or [`Free`][vertax.Free].
    - `softening`: the length $\varepsilon$ below which an edge is rounded off,
        $\ell = \sqrt{|d|^2 + \varepsilon^2}$; it makes a four-fold vertex (an edge of length 0) a smooth
        point of every energy. 0 switches it off; by default $10^{-3}$ of the root mean cell area,
        which changes the length of a typical edge by parts in a million. (Of an arc, it is the chord.)
    - `angles`, shape `(edges,)`: the angle $\alpha$ of each edge, in radians. Every edge owns one,
        since a T1 transition may put it on the outline, but only those of arcs count. Beyond 0.98 π
        (nearly a circle) they are bounded smoothly, see `edge_angles`. Left out: all edges are
        straight.
    - `inner_arcs`: whether edges between two cells are arcs too, as in a foam; otherwise the edges on
        the outline are.
    - `pinned`, shape `(vertices,)`: which vertices do not move when the tissue relaxes. T1 transitions
        leave edges alone that end at one.
    - `angle_length`: the length that makes an angle a degree of freedom like a position, so that
        solvers may measure steps and forces without knowing which is which; by default half the root
        mean cell area, about what moves the middle of an arc as far as a vertex.

    **Raises:**

    - `ValueError` for positions, angles or pins of the wrong shape or that are not finite, a negative
        softening, an `angle_length` that is not positive, a boundary that does not go with the topology
        (free if and only if there is an exterior), or angles where no edge can be an arc.
    """

    vertices: Float[Array, "vertices 2"]
    topology: Topology
    boundary: AbstractBoundary
    softening: Float[Array, ""]
    arcs: Arcs | None
    """The angles of edges and what belongs to them; None if all edges are straight."""
    pinned: Bool[Array, " vertices"] | None

    def __init__(
        self,
        vertices: ArrayLike,
        topology: Topology,
        boundary: AbstractBoundary,
        softening: float | Float[Array, ""] | None = None,
        *,
        angles: ArrayLike | None = None,
        inner_arcs: bool = False,
        pinned: ArrayLike | None = None,
        angle_length: float | Float[Array, ""] | None = None,
    ):
        vertices = jnp.asarray(vertices, jnp.result_type(vertices, jnp.float32))
        if vertices.shape != (topology.n_vertices, 2):
            raise ValueError(
                f"Argument `vertices` must have shape ({topology.n_vertices}, 2) to match the topology, "
                f"but has {vertices.shape}."
            )
        if is_concrete(vertices) and not np.isfinite(np.asarray(vertices)).all():
            raise ValueError("Argument `vertices` must be finite, but holds NaN or infinity.")
        if isinstance(boundary, Free) != topology.exterior:
            raise ValueError(
                "Argument `boundary` must be Free() if the topology has an exterior, and only then, but "
                f"it is {type(boundary).__name__} with {'an' if topology.exterior else 'no'} exterior."
            )
        self.vertices = vertices
        self.topology = topology
        self.boundary = boundary
        if angles is not None and not (topology.exterior or inner_arcs):
            raise ValueError(
                "Argument `angles` is for arcs, but a periodic tissue has none: pass `inner_arcs=True`, "
                "or no angles."
            )
        self.arcs = None
        if angles is not None:
            angles = _checked_angles(angles, vertices.dtype, topology)
            self.arcs = Arcs(angles, jnp.ones((), vertices.dtype), inner=inner_arcs)
        self.pinned = None if pinned is None else jnp.asarray(pinned, bool)
        if self.pinned is not None and self.pinned.shape != (topology.n_vertices,):
            raise ValueError(
                f"Argument `pinned` must have shape ({topology.n_vertices},), but has "
                f"{self.pinned.shape}."
            )
        self.softening = jnp.zeros((), vertices.dtype)
        if softening is None or (angles is not None and angle_length is None):
            # Padded, so that similar sizes share the compiled function.
            known = all(map(is_concrete, jax.tree.leaves(self)))
            padded = self.with_capacity(size_class(self.n_cells)) if known else self
            size = jnp.sqrt(jax.lax.stop_gradient(_mean_area(padded)))
            softening = 1e-3 * size if softening is None else softening
            angle_length = 0.5 * size if angle_length is None else angle_length
        softening = jnp.asarray(softening, vertices.dtype)
        if is_concrete(softening) and not softening >= 0:
            raise ValueError(f"Argument `softening` must be at least 0, but is {softening}.")
        self.softening = softening
        if self.arcs is not None:
            length = jnp.asarray(angle_length, vertices.dtype)
            if is_concrete(length) and not length > 0:
                raise ValueError(f"Argument `angle_length` must be positive, but is {length}.")
            self.arcs = Arcs(self.arcs.angles, length, inner=inner_arcs)

    @property
    def angles(self) -> Float[Array, " edges"] | None:
        """The angle of each edge, of which only those of arcs count; None if all edges are straight."""
        return None if self.arcs is None else self.arcs.angles

    @property
    def angle_length(self) -> Float[Array, ""] | None:
        """The length that makes an angle a degree of freedom; None if all edges are straight."""
        return None if self.arcs is None else self.arcs.length

    @property
    def inner_arcs(self) -> bool:
        """Whether edges between two cells are arcs too."""
        return self.arcs is not None and self.arcs.inner

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

    @property
    def alive(self) -> Bool[Array, " cells"]:
        """Which cells there are; the others are spare slots, see `with_capacity`."""
        return self.topology.alive

    @compiled_property
    def neighbour_counts(self) -> Int[Array, " cells"]:
        """Number of sides of each cell."""
        return self.topology.neighbour_counts

    @compiled_property
    def edge_segments(self) -> tuple[Float[Array, "edges 2"], Float[Array, "edges 2"]]:
        """First vertex of each edge, and the edge as a vector from there across periodic boundaries."""
        x, y, dx, dy = self._segments()
        return jnp.stack([x, y], axis=-1), jnp.stack([dx, dy], axis=-1)

    @compiled_property
    def edge_vectors(self) -> Float[Array, "edges 2"]:
        """Each edge as a vector, from its first to its second vertex across periodic boundaries."""
        return self.edge_segments[1]

    def edge_points(self, fractions: Float[Array, " points"]) -> Float[Array, "edges points 2"]:
        """Points on each edge at some fractions (0 to 1) of its length.

        Edges across a periodic boundary go on beyond the box.
        """
        first, vector = self.edge_segments
        if self.arcs is None:
            return first[:, None] + fractions[:, None] * vector[:, None]
        return arc_points(first, vector, self.edge_angles, fractions)

    @property
    def is_arc(self) -> Bool[Array, " edges"]:
        """Which edges are arcs; the angles of the others do not count."""
        if self.arcs is None:
            return jnp.zeros(self.n_edges, bool)
        if not self.arcs.inner:
            return self.topology.on_outline
        spare = self.topology.spare
        return self.topology.alive_edges if spare else jnp.ones(self.n_edges, bool)

    @compiled_property
    def edge_angles(self) -> Float[Array, " edges"]:
        """Angle between the chord and the tangents of each edge, positive if it bulges to its right.

        That is out of the cell on its left; 0 for straight edges. Always between -π and π, where an
        edge is an arc: a minimiser may overstep that in `angles`, but not here.
        """
        if self.arcs is None:
            return jnp.zeros(self.n_edges, self.vertices.dtype)
        return jnp.where(self.is_arc, bounded(self.arcs.angles), 0)

    @compiled_property
    def edge_curvatures(self) -> Float[Array, " edges"]:
        r"""Curvature $1/R$ of each edge, with the sign of its angle.

        In equilibrium under a line tension $\gamma$ this is the difference of the pressures on its left
        and right over $\gamma$ (Young–Laplace).
        """
        chord = self._chords(self._segments())
        return 2 * jnp.sin(self.edge_angles) / jnp.where(chord > 0, chord, 1)

    @compiled_property
    def edge_tangents(self) -> tuple[Float[Array, "edges 2"], Float[Array, "edges 2"]]:
        """Unit vectors along each edge at its first and at its second vertex."""
        chord, angle = self.edge_vectors, self.edge_angles
        squared = jnp.sum(chord**2, axis=-1, keepdims=True)
        unit = chord / jnp.sqrt(jnp.where(squared > 0, squared, 1))
        left = jnp.stack([-unit[:, 1], unit[:, 0]], axis=-1)
        along, aside = jnp.cos(angle)[:, None] * unit, jnp.sin(angle)[:, None] * left
        return along - aside, along + aside

    @compiled_property
    def edge_lengths(self) -> Float[Array, " edges"]:
        """Length of each edge (softened, see the class)."""
        return self.measured().lengths

    @compiled_property
    def areas(self) -> Float[Array, " cells"]:
        """Signed area of each cell, positive for an upright (counter-clockwise) cell."""
        return self.measured().areas

    @compiled_property
    def perimeters(self) -> Float[Array, " cells"]:
        """Perimeter of each cell (softened, see the class)."""
        return self.measured().perimeters

    @compiled_property
    def shape_factors(self) -> Float[Array, " cells"]:
        r"""Observed shape factor $P/\sqrt{A}$ of each cell (Bi et al. 2015, doi:10.1038/nphys3471)."""
        areas = jnp.where(self.alive, self.areas, 1) if self.topology.spare else self.areas
        return self.perimeters / jnp.sqrt(areas)

    @compiled_property
    def corners(self) -> Float[Array, "halfedges 2"]:
        """Source of each half-edge, in the frame of the cell on its left.

        The corners of one cell, in the order of `topology.next`, are its polygon drawn whole.
        """
        return jnp.repeat(self.vertices, 3, axis=0) + self.boundary.translation(self.topology.frame)

    def corners_of(self, half_edges: Int[Array, "*some"]) -> Float[Array, "*some 2"]:
        """The rows of `corners` of some half-edges; no others are looked at."""
        image = self.boundary.translation(take(self.topology.frame, half_edges))
        return take(self.vertices, source(half_edges)) + image

    @compiled_property
    def centroids(self) -> Float[Array, "cells 2"]:
        """Centre of area of each cell, in the frame of the cell; 0 of spare slots."""
        # Relative to the mean corner: the polygon formula loses digits far from the origin.
        m, corners = self.topology, self.corners
        face_sums = lambda values: jax.ops.segment_sum(values, m.cell, m.n_faces)
        count = face_sums(jnp.ones_like(corners[:, :1]))
        spare = jnp.append(~m.alive, jnp.ones(2, bool))[:, None] if m.spare else None
        over = lambda sums, x: sums / (x if spare is None else jnp.where(spare, 1, x))
        centre = over(face_sums(corners), count)
        p = corners - take(centre, m.cell)
        q = take(p, m.next)
        area = _cross(p, q) / 2
        moment = (p + q) * area[:, None] / 3
        if self.arcs is not None:
            angle = take(self.edge_angles, m.edge)
            angle = jnp.where(m.forward, angle, -angle)
            chord = q - p
            squared = jnp.sum(chord**2, axis=-1)
            bulge = squared * area_factor(angle)
            right = jnp.stack([chord[:, 1], -chord[:, 0]], axis=-1)
            area += bulge
            moment += (p + q) * bulge[:, None] / 2
            moment += right * (squared * moment_factor(angle))[:, None]
        centre = centre + over(face_sums(moment), face_sums(area)[:, None])
        return (centre if spare is None else jnp.where(spare, 0, centre))[: self.n_cells]

    @compiled_property
    def sides(self) -> Float[Array, "halfedges parts"]:
        """Where each half-edge begins, in the frame of the cell on its left, and its vector.

        If there are arcs, followed by its angle: positive where it bulges to its right, out of that cell.
        """
        return self.sides_of(jnp.arange(self.topology.n_half_edges))

    def sides_of(self, half_edges: Int[Array, " some"]) -> Float[Array, "some parts"]:
        """The rows of `sides` of some half-edges; no others are looked at."""
        m = self.topology
        start = self.corners_of(half_edges)
        parts = [start, self.corners_of(take(m.next, half_edges)) - start]
        if self.arcs is not None:
            angles = take(self.edge_angles, take(m.edge, half_edges))
            parts.append(jnp.where(take(m.forward, half_edges), angles, -angles)[:, None])
        return jnp.concatenate(parts, axis=-1)

    @compiled_property
    def overlaps(self) -> Overlaps:
        """Where cells overlap: whether the tissue tiles the plane, as every tissue should."""
        return find_overlaps(self.topology, self.sides, self.areas)

    @property
    def configuration(self) -> PyTree[Float[Array, "..."]]:
        """The degrees of freedom that an equilibrium relaxes: `vertices`.

        With arcs a pair, `(vertices, angles * angle_length)`.
        """
        return self.vertices if self.arcs is None else (self.vertices, self.arcs.scaled)

    def with_configuration(self, configuration: PyTree[Float[Array, "..."]]) -> Tissue:
        """The same tissue with its degrees of freedom replaced.

        What cannot move (pinned and spare vertices, and angles of straight edges) stays as it is.
        """
        vertices, scaled = self._split(configuration)
        held = self.held
        if held is not None:
            vertices = jnp.where(held[:, None], self.vertices, vertices)
        moved = self.with_vertices(vertices)
        if scaled is None or self.arcs is None:
            return moved
        angles = jnp.where(self.is_arc, scaled / self.arcs.length, self.arcs.angles)
        return moved.with_angles(angles)

    def by_row(self, values: Float[Array, " vertices"]) -> PyTree[Float[Array, "..."]]:
        """A number a vertex for each row of the `configuration`: of an arc, the lesser of its ends."""
        if self.arcs is None:
            return values
        return values, jnp.min(take(values, self.topology.edge_vertices), axis=-1)

    def with_vertices(self, vertices: Float[Array, "vertices 2"]) -> Tissue:
        """The same tissue with its vertices, also pinned ones, elsewhere."""
        return eqx.tree_at(lambda t: t.vertices, self, vertices)

    def with_angles(self, angles: Float[Array, " edges"]) -> Tissue:
        """The same tissue, which has arcs, with other angles."""
        return eqx.tree_at(lambda t: t.arcs.angles, self, angles)

    def with_capacity(self, n_cells: int) -> Tissue:
        """The same tissue with room for more cells to come; works under `jax.jit`.

        Arrays of cells, edges and vertices become longer by spare slots, in which `alive` is False: their
        areas, perimeters and edge lengths are 0, and they feel no force. Divisions take them and cells that
        vanish leave some behind. Cells keep their numbers. A periodic tissue has then `2 * n_cells` vertices
        and `3 * n_cells` edges, a free one those of one cell less; parameters that are one a cell, or one an
        edge, need as many entries.

        **Arguments:**

        - `n_cells`: number of cells that there is to be room for, living ones included.

        **Returns:** the tissue, whose `n_cells` that is.

        **Raises:**

        - `ValueError` if there is room for more already.
        """
        topology = with_slots(self.topology, n_cells)

        def longer(x: Array, size: int, filling: Array | np.ndarray | float = 0) -> Array:
            xp = np if is_concrete(x) else jnp
            more = xp.broadcast_to(filling, (size - len(x), *x.shape[1:])).astype(x.dtype)
            return jnp.asarray(xp.concatenate([xp.asarray(x), more]))

        of_vertices = lambda x: longer(x, topology.n_vertices)
        of_edges = lambda x: longer(x, topology.n_edges)
        xp = np if is_concrete(self.vertices) else jnp
        middle = xp.mean(xp.asarray(self.vertices), axis=0)
        vertices = longer(self.vertices, topology.n_vertices, middle)
        return self._with(topology, vertices, of_vertices, of_edges)

    def without_spare(self) -> Tissue:
        """The same tissue without spare slots: cells, edges and vertices are numbered anew, in their order.

        **Returns:** the tissue, as large as what lives of it.

        **Raises:**

        - `TypeError` under `jax.jit`: its size depends on what lives.
        """
        if not self.topology.spare:
            return self
        topology, vertices, edges = without_slots(self.topology)
        of_vertices, of_edges = (lambda x: x[vertices]), (lambda x: x[edges])
        return self._with(topology, of_vertices(self.vertices), of_vertices, of_edges)

    def drift(self, configuration: PyTree[Float[Array, "..."]]) -> Float[Array, " modes"]:
        """How far a configuration strayed from that of this tissue in ways that have no energy.

        These are the motions of the whole, see [`AbstractBoundary`][vertax.AbstractBoundary], and the
        degrees of freedom that `with_configuration` ignores. All are lengths.
        """
        vertices, scaled = self._split(configuration)
        here, there = self.gathered(self.vertices), self.gathered(vertices)
        drift = [self.boundary.drift(there, here, self.pinned)]
        held = self.held
        if held is not None:
            drift.append(jnp.where(held[:, None], vertices - self.vertices, 0).ravel())
        if scaled is not None and self.arcs is not None:
            drift.append(jnp.where(self.is_arc, 0, scaled - self.arcs.scaled))
        return jnp.concatenate(drift)

    def settled(self, start: Tissue) -> Tissue:
        """The same shape, moved as a whole to where it has no drift from the vertices of `start`."""
        here, there = self.gathered(self.vertices), self.gathered(start.vertices)
        return self.with_vertices(self.boundary.settle(here, there, self.pinned))

    def held_as(self, start: Tissue) -> Tissue:
        """This tissue in the boundary of `start` and with its vertices.

        What it lends to a configuration (pinned vertices, what `drift` counts from) is then that of
        `start`; differentiable are the boundary and the pinned vertices.
        """
        vertices = jax.lax.stop_gradient(start.vertices)
        if start.pinned is not None:
            vertices = jnp.where(start.pinned[:, None], start.vertices, vertices)
        lent = (start.boundary, vertices)
        return eqx.tree_at(lambda t: (t.boundary, t.vertices), self, lent)

    def carried(self, boundary: AbstractBoundary) -> Tissue:
        """The same tissue, deformed uniformly with its space into another one, pinned vertices too."""
        vertices = self.boundary.carry(self.vertices, boundary)
        return eqx.tree_at(lambda t: (t.boundary, t.vertices), self, (boundary, vertices))

    def with_topology(self, topology: Topology) -> Tissue:
        """The same vertices, connected in another way."""
        return eqx.tree_at(lambda t: t.topology, self, topology)

    @property
    def held(self) -> Bool[Array, " vertices"] | None:
        """Which vertices do not move: pinned ones and those of spare slots; None if all do."""
        if not self.topology.spare:
            return self.pinned
        spare = ~self.topology.alive_vertices
        return spare if self.pinned is None else self.pinned | spare

    def _with(
        self,
        topology: Topology,
        vertices: Float[Array, "other 2"],
        of_vertices: Callable[[Array], Array],
        of_edges: Callable[[Array], Array],
    ) -> Tissue:
        """A tissue of another size; and what becomes of arrays with one entry a vertex, or one an edge."""
        tissue = eqx.tree_at(lambda t: (t.topology, t.vertices), self, (topology, vertices))
        if self.pinned is not None:
            tissue = eqx.tree_at(lambda t: t.pinned, tissue, of_vertices(self.pinned))
        return tissue if self.arcs is None else tissue.with_angles(of_edges(self.arcs.angles))

    def gathered(self, vertices: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """Vertices with those of spare slots in the middle of the others, where they count for nothing."""
        if not self.topology.spare:
            return vertices
        alive = self.topology.alive_vertices[:, None]
        middle = jnp.sum(jnp.where(alive, vertices, 0), axis=0) / jnp.sum(alive)
        return jnp.where(alive, vertices, middle)

    def _split(
        self, configuration: PyTree[Float[Array, "..."]]
    ) -> tuple[Float[Array, "vertices 2"], Float[Array, " edges"] | None]:
        return (configuration, None) if self.arcs is None else configuration

    def _segments(self) -> tuple[Float[Array, " edges"], ...]:
        """The first vertex of each edge, x and y, and the edge as a vector from there."""
        # Apart, from here to areas and lengths: pairs would be taken apart and put together again in every
        # product with a Hessian.
        m = self.topology
        following = edge_neighbourhood(m)[-1]
        offset = self.boundary.translation(take(m.frame, following) - take(m.frame, m.half_edge))
        x, y, to_x, to_y = gather_at_ends(m, self.vertices)
        return x, y, to_x + offset[:, 0] - x, to_y + offset[:, 1] - y

    def _chords(self, segments: tuple[Float[Array, " edges"], ...]) -> Float[Array, " edges"]:
        """How far the ends of each edge are from each other (softened)."""
        _, _, dx, dy = segments
        squared = dx * dx + dy * dy + self.softening**2
        # An edge of length exactly 0 without softening has no direction: the root of 1, less 1, keeps the
        # derivative finite there (0, the middle of all its one-sided slopes).
        at_zero = (squared == 0).astype(squared.dtype)
        return jnp.sqrt(squared + at_zero) - at_zero

    def _area_shares(
        self, segments: tuple[Float[Array, " edges"], ...]
    ) -> tuple[Float[Array, " edges"], Float[Array, " edges"]]:
        """What each edge contributes to the areas of its left and right cell (shoelace formula)."""
        m = self.topology
        x, y, dx, dy = segments

        frame = take(m.frame, m.half_edge)
        image = self.boundary.translation(frame)
        left = 0.5 * ((x + image[:, 0]) * dy - (y + image[:, 1]) * dx)
        right = -left
        if not m.exterior:
            # The right cell's corner at the first vertex, one slot clockwise, may be in another image.
            shift = self.boundary.translation(take(m.frame, clockwise(m.half_edge)) - frame)
            right -= 0.5 * (shift[:, 0] * dy - shift[:, 1] * dx)
        if self.arcs is None:
            return left, right
        bulge = (dx**2 + dy**2) * area_factor(self.edge_angles)
        return left + bulge, right - bulge

    def measured(self) -> Measurements:
        """`edge_lengths`, `areas` and `perimeters`, from one look at the vertices."""
        segments = self._segments()
        lengths = self._chords(segments)
        if self.topology.spare:
            lengths = jnp.where(self.topology.alive_edges, lengths, 0)
        if self.arcs is not None:
            lengths = lengths * length_factor(self.edge_angles)
        areas = self.cell_sums(self._area_shares(segments))
        return Measurements(lengths, areas, self.cell_sums((lengths, lengths)))

    def cell_sums(
        self, shares: tuple[Float[Array, " edges"], Float[Array, " edges"]]
    ) -> Float[Array, " cells"]:
        """Sums over the edges of each cell of what they contribute to it on their left and right."""
        m = self.topology
        # The exterior, number n_cells, is out of range and dropped.
        mode = "drop" if m.exterior or m.spare else "promise_in_bounds"
        ids = jnp.concatenate([m.edge_cells[:, 0], m.edge_cells[:, 1]])
        return jax.ops.segment_sum(jnp.concatenate(shares), ids, self.n_cells, mode=mode)


def _checked_angles(
    angles: ArrayLike, dtype: jnp.dtype, topology: Topology
) -> Float[Array, " edges"]:
    angles = jnp.asarray(angles, dtype)
    if angles.shape != (topology.n_edges,):
        raise ValueError(
            f"Argument `angles` must have shape ({topology.n_edges},), but has {angles.shape}."
        )
    if is_concrete(angles) and not np.isfinite(np.asarray(angles)).all():
        raise ValueError("Argument `angles` must be finite, but holds NaN or infinity.")
    return angles


@eqx.filter_jit
def _mean_area(tissue: Tissue) -> Float[Array, ""]:
    return mean_area(tissue)


def mean_area(tissue: Tissue) -> Float[Array, ""]:
    """The mean area of the cells that there are."""
    if isinstance(tissue.boundary, Periodic):
        number = jnp.sum(tissue.alive) if tissue.topology.spare else tissue.n_cells
        return jnp.abs(tissue.boundary.area) / number
    areas = jnp.abs(tissue.areas)
    return jnp.sum(areas) / jnp.sum(tissue.alive) if tissue.topology.spare else jnp.mean(areas)


def _cross(p: Float[Array, "*n 2"], q: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
