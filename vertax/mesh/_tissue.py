"""A tissue and its geometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.arcs import arc_points, area_factor, bounded, length_factor, moment_factor
from vertax._base.checks import check_number, check_shape
from vertax._base.half_edges import clockwise, source
from vertax._base.indexing import take
from vertax._base.model_checks import check_planar
from vertax._base.plane import cross
from vertax._base.sums import total
from vertax._base.tracing import compiled_property, is_concrete
from vertax.mesh._arcs import Arcs
from vertax.mesh._boundary import AbstractBoundary, Free, Periodic
from vertax.mesh._capacity import size_class, with_slots, without_slots
from vertax.mesh._curved import area_shares, check_surface, space_chords
from vertax.mesh._edge_ends import gather_at_ends
from vertax.mesh._overlaps import Overlaps, find_overlaps
from vertax.mesh._topology import Topology, edge_neighbourhood
from vertax.surfaces import AbstractSurface


class Measurements(NamedTuple):
    """The properties of a tissue that most energies depend on."""

    lengths: Float[Array, " edges"]
    areas: Float[Array, " cells"]
    perimeters: Float[Array, " cells"]


class Tissue(eqx.Module):
    r"""A tissue in the plane or on a surface: vertices, topology and boundary.

    The geometry is differentiable in `vertices`, in the angles of `arcs` and in the boundary (the lattice of
    a periodic box).

    Edges are straight, or circular arcs (paper, Methods, "Bounded mode"): an arc with the angle
    $\alpha$ between its chord $c$ and its tangents has the radius $R = c / (2 \sin\alpha)$ and the length
    $c\,\alpha / \sin\alpha$, and adds the area $c^2 (\alpha - \sin\alpha\cos\alpha) / (4 \sin^2\alpha)$
    to the cell on the left of its edge (for $\alpha > 0$ it bulges out of that cell). On the outline of a
    free tissue the cell is always on the left.

    **Arguments:**

    - `vertices`, shape `(vertices, 2)`: positions, in units of length; they may lie outside the periodic box.
    - `topology`: the [`Topology`][vertax.Topology].
    - `boundary`: [`Periodic`][vertax.Periodic] or [`Free`][vertax.Free].
    - `softening`: the length $\varepsilon$ in the softened edge length
        $\ell = \sqrt{|d|^2 + \varepsilon^2}$, with which every energy is smooth at a four-fold vertex (an
        edge of length 0). 0 for no softening; by default $10^{-3}$ of the square root of the mean cell area,
        which changes a typical edge length by a relative $10^{-6}$. (Of an arc the chord is softened.)
    - `angles`, shape `(edges,)`: the angle $\alpha$ of each edge, in radians. Each edge has one, since
        a T1 transition may move it to the outline; angles of straight edges are ignored. Above 0.98 π
        (nearly a circle) they are limited smoothly, see `edge_angles`. By default all edges are straight.
    - `inner_arcs`: whether edges between two cells are arcs too, as in a foam; by default only edges on the
        outline are.
    - `pinned`, shape `(vertices,)`: which vertices do not move when the tissue relaxes. Edges with a pinned
        end do not flip in T1 transitions.
    - `angle_length`: factor that converts an angle to a length, so that all degrees of freedom have the same
        unit; by default half the square root of the mean cell area, for which the midpoint of an arc moves
        about as far as a vertex.
    - `surface`: the surface on which the tissue lies, of `vertax.surfaces`; None for the plane. Vertices are
        then coordinates in its chart, while edge lengths, areas, perimeters and shape factors are those in
        space: an edge is a straight chord, a cell the part of the surface above its polygon in the chart.

    **Raises:**

    - `ValueError` for positions, angles or pins of the wrong shape or that are not finite, a negative
        softening, an `angle_length` that is not positive, a boundary that does not match the topology
        (free if and only if there is an exterior), angles in a tissue without arcs or on a surface, or a
        surface that is not finite or has another period than the box.
    - `TypeError` for a surface that is none.
    """

    vertices: Float[Array, "vertices 2"]
    topology: Topology
    boundary: AbstractBoundary
    softening: Float[Array, ""]
    arcs: Arcs | None
    """The angles of the edges; None if all edges are straight."""
    pinned: Bool[Array, " vertices"] | None
    surface: AbstractSurface | None = eqx.field(default=None, kw_only=True)
    """The surface on which the tissue lies; None for the plane."""

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
        surface: AbstractSurface | None = None,
    ):
        vertices = jnp.asarray(vertices, jnp.result_type(vertices, jnp.float32))
        check_shape("vertices", vertices, (topology.n_vertices, 2))
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
                "Argument `angles` must be None in a tissue without arcs, but a periodic tissue has none. "
                "Pass `inner_arcs=True`, or no angles."
            )
        self.arcs = None
        if angles is not None:
            angles = _checked_angles(angles, vertices.dtype, topology)
            self.arcs = Arcs(angles, jnp.ones((), vertices.dtype), inner=inner_arcs)
        self.pinned = None if pinned is None else jnp.asarray(pinned, bool)
        if self.pinned is not None:
            remedy = "Give one boolean for each vertex."
            check_shape("pinned", self.pinned, (topology.n_vertices,), remedy=remedy)
        if surface is not None:
            check_surface(surface, vertices, boundary, arcs=angles is not None)
        self.surface = surface
        self.softening = jnp.zeros((), vertices.dtype)
        if softening is None or (angles is not None and angle_length is None):
            # Padded, so that tissues of similar size share the compiled function.
            concrete = all(map(is_concrete, jax.tree.leaves(self)))
            padded = self.with_capacity(size_class(self.n_cells)) if concrete else self
            size = jnp.sqrt(jax.lax.stop_gradient(padded.mean_area))
            softening = 1e-3 * size if softening is None else softening
            angle_length = 0.5 * size if angle_length is None else angle_length
        softening = jnp.asarray(softening, vertices.dtype)
        check_number("softening", softening, at_least=0)
        self.softening = softening
        if self.arcs is not None:
            length = jnp.asarray(angle_length, vertices.dtype)
            check_number("angle_length", length, above=0)
            self.arcs = Arcs(self.arcs.angles, length, inner=inner_arcs)

    @property
    def angles(self) -> Float[Array, " edges"] | None:
        """The angle of each edge, ignored for straight edges; None if all edges are straight."""
        return None if self.arcs is None else self.arcs.angles

    @property
    def angle_length(self) -> Float[Array, ""] | None:
        """Factor that converts an angle to a length; None if all edges are straight."""
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
        """Which cells exist; the others are spare slots, see `with_capacity`."""
        return self.topology.alive

    @compiled_property
    def neighbour_counts(self) -> Int[Array, " cells"]:
        """Number of sides of each cell."""
        return self.topology.neighbour_counts

    @compiled_property
    def edge_segments(self) -> tuple[Float[Array, "edges 2"], Float[Array, "edges 2"]]:
        """First vertex of each edge, and the vector to its second vertex across periodic boundaries."""
        x, y, dx, dy = self._segments()
        return jnp.stack([x, y], axis=-1), jnp.stack([dx, dy], axis=-1)

    @compiled_property
    def edge_vectors(self) -> Float[Array, "edges 2"]:
        """Vector from the first to the second vertex of each edge, across periodic boundaries."""
        return self.edge_segments[1]

    @compiled_property
    def edge_chords(self) -> Float[Array, "edges axes"]:
        """Vector from the first to the second vertex of each edge, in space on a surface (three axes)."""
        if self.surface is None:
            return self.edge_vectors
        return space_chords(self.surface, self._segments())

    def edge_points(self, fractions: Float[Array, " points"]) -> Float[Array, "edges points 2"]:
        """Points on each edge at given fractions (0 to 1) of its length.

        Points of edges across a periodic boundary may be outside of the box.
        """
        first, vector = self.edge_segments
        if self.arcs is None:
            return first[:, None] + fractions[:, None] * vector[:, None]
        return arc_points(first, vector, self.edge_angles, fractions)

    @property
    def is_arc(self) -> Bool[Array, " edges"]:
        """Which edges are arcs; the angles of the others are ignored."""
        if self.arcs is None:
            return jnp.zeros(self.n_edges, bool)
        if not self.arcs.inner:
            return self.topology.on_outline
        spare = self.topology.spare
        return self.topology.alive_edges if spare else jnp.ones(self.n_edges, bool)

    @compiled_property
    def edge_angles(self) -> Float[Array, " edges"]:
        """Angle between the chord and the tangents of each edge, positive if it bulges to its right.

        A positive angle bulges out of the cell on the left; straight edges have the angle 0. Limited to the
        range between -π and π of arcs, which a minimiser may leave in `angles`.
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
        """Unit tangents of each edge at its first and at its second vertex."""
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
        """Signed area of each cell, positive for counter-clockwise cells; negative if inside out."""
        return self.measured().areas

    @compiled_property
    def mean_area(self) -> Float[Array, ""]:
        """Mean area of the living cells."""
        n_alive = jnp.sum(self.alive) if self.topology.spare else self.n_cells
        if isinstance(self.boundary, Periodic) and self.surface is None:
            return jnp.abs(self.boundary.area) / n_alive
        return jnp.sum(jnp.abs(self.areas)) / n_alive

    @compiled_property
    def cell_size(self) -> Float[Array, ""]:
        """Square root of the mean area of the living cells, the unit of lengths.

        Angles of arcs beyond 2.5 are clipped, so that the area stays finite.
        """
        tissue = self
        if self.angles is not None:
            tissue = self.with_angles(jnp.clip(self.angles, -_LARGEST_ANGLE, _LARGEST_ANGLE))
        return jnp.sqrt(tissue.mean_area)

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

        The corners of one cell, in the order of `topology.next`, are its polygon.
        """
        return jnp.repeat(self.vertices, 3, axis=0) + self.boundary.translation(self.topology.frame)

    def corners_of(self, half_edges: Int[Array, "*some"]) -> Float[Array, "*some 2"]:
        """The rows of `corners` of some half-edges, without computing the others."""
        image = self.boundary.translation(take(self.topology.frame, half_edges))
        return take(self.vertices, source(half_edges)) + image

    @compiled_property
    def centroids(self) -> Float[Array, "cells 2"]:
        """Centroid of each cell, in the frame of the cell; 0 for spare slots."""
        # Relative to the mean corner, because the polygon formula loses digits far from the origin.
        m, corners = self.topology, self.corners
        face_sums = lambda values: jax.ops.segment_sum(values, m.cell, m.n_faces)
        count = face_sums(jnp.ones_like(corners[:, :1]))
        spare = jnp.append(~m.alive, jnp.ones(2, bool))[:, None] if m.spare else None
        over = lambda sums, x: sums / (x if spare is None else jnp.where(spare, 1, x))
        centre = over(face_sums(corners), count)
        p = corners - take(centre, m.cell)
        q = take(p, m.next)
        area = cross(p, q) / 2
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
        """Start of each half-edge, in the frame of the cell on its left, and its vector.

        With arcs followed by its angle, positive if it bulges to its right, out of that cell.
        """
        return self.sides_of(jnp.arange(self.topology.n_half_edges))

    def sides_of(self, half_edges: Int[Array, " some"]) -> Float[Array, "some parts"]:
        """The rows of `sides` of some half-edges, without computing the others."""
        m = self.topology
        start = self.corners_of(half_edges)
        parts = [start, self.corners_of(take(m.next, half_edges)) - start]
        if self.arcs is not None:
            angles = take(self.edge_angles, take(m.edge, half_edges))
            parts.append(jnp.where(take(m.forward, half_edges), angles, -angles)[:, None])
        return jnp.concatenate(parts, axis=-1)

    @compiled_property
    def overlaps(self) -> Overlaps:
        """Overlaps of cells; a tissue without overlaps tiles the plane."""
        return find_overlaps(self.topology, self.sides, self.areas)

    @property
    def configuration(self) -> Any:
        """The degrees of freedom of a relaxation: `vertices`.

        With arcs a pair, `(vertices, angles * angle_length)`.
        """
        return self.vertices if self.arcs is None else (self.vertices, self.arcs.scaled)

    def with_configuration(self, configuration: Any) -> Tissue:
        """The tissue with other degrees of freedom.

        Pinned and spare vertices and angles of straight edges do not change.
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

    def by_row(self, values: Float[Array, " vertices"]) -> Any:
        """Values of vertices as values of the rows of `configuration`; of an arc the minimum of its ends."""
        if self.arcs is None:
            return values
        return values, jnp.min(take(values, self.topology.edge_vertices), axis=-1)

    def with_vertices(self, vertices: Float[Array, "vertices 2"]) -> Tissue:
        """The tissue with other vertices, including pinned ones."""
        return eqx.tree_at(lambda t: t.vertices, self, vertices)

    def with_surface(self, surface: AbstractSurface | None) -> Tissue:
        """The tissue on a surface, with the same coordinates in the chart; None for the plane.

        **Raises:** as the constructor.
        """
        if surface is not None:
            check_surface(surface, self.vertices, self.boundary, arcs=self.arcs is not None)
        return eqx.tree_at(lambda t: t.surface, self, surface, is_leaf=lambda x: x is None)

    def with_angles(self, angles: Float[Array, " edges"]) -> Tissue:
        """The tissue, which must have arcs, with other angles."""
        return eqx.tree_at(lambda t: t.arcs.angles, self, angles)

    def with_capacity(self, n_cells: int) -> Tissue:
        """The tissue with spare slots for new cells; works under `jax.jit`.

        Arrays of cells, edges and vertices are extended by spare slots, with `alive` False, areas,
        perimeters and edge lengths 0, and force 0. A division uses one spare slot, and a cell that vanishes
        becomes one. Cells keep their numbers. A periodic tissue then has `2 * n_cells` vertices and
        `3 * n_cells` edges, a free tissue `2 * n_cells - 2` and `3 * n_cells - 3`; parameters of cells and
        edges need as many entries.

        **Arguments:**

        - `n_cells`: the capacity: number of cells, living and spare.

        **Returns:** the tissue with this `n_cells`.

        **Raises:**

        - `ValueError` if the tissue has a larger capacity.
        """
        topology = with_slots(self.topology, n_cells)

        def extend(x: Array, size: int, filling: Array | np.ndarray | float = 0) -> Array:
            xp = np if is_concrete(x) else jnp
            rows = xp.broadcast_to(filling, (size - len(x), *x.shape[1:])).astype(x.dtype)
            return jnp.asarray(xp.concatenate([xp.asarray(x), rows]))

        of_vertices = lambda x: extend(x, topology.n_vertices)
        of_edges = lambda x: extend(x, topology.n_edges)
        xp = np if is_concrete(self.vertices) else jnp
        middle = xp.mean(xp.asarray(self.vertices), axis=0)
        vertices = extend(self.vertices, topology.n_vertices, middle)
        return self._with(topology, vertices, of_vertices, of_edges)

    def without_spare(self) -> Tissue:
        """The tissue without spare slots; cells, edges and vertices are renumbered in the same order.

        **Returns:** the tissue of living cells.

        **Raises:**

        - `TypeError` under `jax.jit`, because the size of the result depends on values.
        """
        if not self.topology.spare:
            return self
        topology, vertices, edges = without_slots(self.topology)
        of_vertices, of_edges = (lambda x: x[vertices]), (lambda x: x[edges])
        return self._with(topology, of_vertices(self.vertices), of_vertices, of_edges)

    def drift(self, configuration: Any) -> Float[Array, " modes"]:
        """Displacement of a configuration from that of this tissue along directions without energy.

        These are the rigid motions, see [`AbstractBoundary`][vertax.AbstractBoundary], and the degrees of
        freedom that `with_configuration` ignores. All components are lengths.
        """
        vertices, scaled = self._split(configuration)
        reference, moved = self.gathered(self.vertices), self.gathered(vertices)
        drift = [self.boundary.drift(moved, reference, self.pinned)]
        held = self.held
        if held is not None:
            drift.append(jnp.where(held[:, None], vertices - self.vertices, 0).ravel())
        if scaled is not None and self.arcs is not None:
            drift.append(jnp.where(self.is_arc, 0, scaled - self.arcs.scaled))
        return jnp.concatenate(drift)

    def settled(self, start: Tissue) -> Tissue:
        """The tissue after the rigid motion that makes its drift from `start` 0."""
        moved, reference = self.gathered(self.vertices), self.gathered(start.vertices)
        return self.with_vertices(self.boundary.settle(moved, reference, self.pinned))

    def held_as(self, start: Tissue) -> Tissue:
        """The tissue with the boundary, the surface and the vertices of `start`.

        Pinned vertices and the reference of `drift` are then those of `start`. The result is differentiable
        in the boundary, the surface and the pinned vertices only.
        """
        vertices = jax.lax.stop_gradient(start.vertices)
        if start.pinned is not None:
            vertices = jnp.where(start.pinned[:, None], start.vertices, vertices)
        parts = lambda t: (t.boundary, t.vertices, t.surface)
        new = (start.boundary, vertices, start.surface)
        return eqx.tree_at(parts, self, new, is_leaf=lambda x: x is None)

    def carried(self, boundary: AbstractBoundary) -> Tissue:
        """The tissue after a uniform deformation into another boundary, including pinned vertices.

        **Raises:**

        - `ValueError` for a tissue on a surface: the period of a surface is fixed.
        """
        check_planar("a deformation of the box", self)
        vertices = self.boundary.carry(self.vertices, boundary)
        return eqx.tree_at(lambda t: (t.boundary, t.vertices), self, (boundary, vertices))

    def with_topology(self, topology: Topology) -> Tissue:
        """The tissue with another topology and the same vertices."""
        return eqx.tree_at(lambda t: t.topology, self, topology)

    @property
    def held(self) -> Bool[Array, " vertices"] | None:
        """Which vertices do not move: pinned vertices and those of spare slots; None if all move."""
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
        """The tissue with another size; `of_vertices` and `of_edges` convert its arrays."""
        tissue = eqx.tree_at(lambda t: (t.topology, t.vertices), self, (topology, vertices))
        if self.pinned is not None:
            tissue = eqx.tree_at(lambda t: t.pinned, tissue, of_vertices(self.pinned))
        return tissue if self.arcs is None else tissue.with_angles(of_edges(self.arcs.angles))

    def gathered(self, vertices: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """The vertices, with those of spare slots at the mean of the others, so that they add no drift."""
        if not self.topology.spare:
            return vertices
        alive = self.topology.alive_vertices[:, None]
        middle = jnp.sum(jnp.where(alive, vertices, 0), axis=0) / jnp.sum(alive)
        return jnp.where(alive, vertices, middle)

    def _split(
        self, configuration: Any
    ) -> tuple[Float[Array, "vertices 2"], Float[Array, " edges"] | None]:
        return (configuration, None) if self.arcs is None else configuration

    def _segments(self) -> tuple[Float[Array, " edges"], ...]:
        """x and y of the first vertex of each edge, and x and y of its vector."""
        # Separate arrays for x and y: pairs would be split and stacked again in each Hessian-vector product.
        m = self.topology
        following = edge_neighbourhood(m)[-1]
        offset = self.boundary.translation(take(m.frame, following) - take(m.frame, m.half_edge))
        x, y, to_x, to_y = gather_at_ends(m, self.vertices)
        return x, y, to_x + offset[:, 0] - x, to_y + offset[:, 1] - y

    def _chords(self, segments: tuple[Float[Array, " edges"], ...]) -> Float[Array, " edges"]:
        """Length of the chord of each edge (softened)."""
        _, _, *chord = segments
        if self.surface is not None:
            chord = space_chords(self.surface, segments).T
        squared = total(part * part for part in chord) + self.softening**2
        # At length 0 without softening the square root is not differentiable: √1 - 1 instead has value 0 and
        # derivative 0, the mean of the one-sided derivatives.
        at_zero = (squared == 0).astype(squared.dtype)
        return jnp.sqrt(squared + at_zero) - at_zero

    def _area_shares(
        self, segments: tuple[Float[Array, " edges"], ...]
    ) -> tuple[Float[Array, " edges"], Float[Array, " edges"]]:
        """Contributions of each edge to the areas of its left and right cell (shoelace formula)."""
        m = self.topology
        if self.surface is not None:
            return area_shares(self.surface, m, self.boundary, segments)
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
        """`edge_lengths`, `areas` and `perimeters`, from one gather of the vertices."""
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
        """Sums over the edges of each cell; `shares` are the contributions to the left and the right cell."""
        m = self.topology
        # The label n_cells of the exterior is out of range and dropped.
        mode = "drop" if m.exterior or m.spare else "promise_in_bounds"
        ids = jnp.concatenate([m.edge_cells[:, 0], m.edge_cells[:, 1]])
        return jax.ops.segment_sum(jnp.concatenate(shares), ids, self.n_cells, mode=mode)


def _checked_angles(
    angles: ArrayLike, dtype: jnp.dtype, topology: Topology
) -> Float[Array, " edges"]:
    angles = jnp.asarray(angles, dtype)
    check_shape("angles", angles, (topology.n_edges,))
    if is_concrete(angles) and not np.isfinite(np.asarray(angles)).all():
        raise ValueError("Argument `angles` must be finite, but holds NaN or infinity.")
    return angles


# Half of the angle that an arc spans, in radians. At this angle the area of the circular segment is 5.3
# times that of the half disc over the same chord.
_LARGEST_ANGLE = 2.5
