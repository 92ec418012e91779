"""The local part of a preconditioner: each edge with its two ends."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.indexing import take
from vertax._base.probe_vector import probe_vector
from vertax._base.sums import total
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue, Topology
from vertax.mesh._edge_ends import EdgeEnds
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.mesh._tissue import Measurements

# The least stiffness of a block, in units of the mean. (Between 0.1 and 3 times this number the number of
# steps is the same.)
_SOFTEST = 1e-2


class Symmetric(NamedTuple):
    """Symmetric matrices of two rows."""

    xx: Float[Array, " n"]
    xy: Float[Array, " n"]
    yy: Float[Array, " n"]

    def stiffened(self, more: Float[Array, "*n"]) -> Symmetric:
        """The sum with a multiple of the identity."""
        return Symmetric(self.xx + more, self.xy, self.yy + more)

    @property
    def positive(self) -> Symmetric:
        """The matrices with negative eigenvalues replaced by 0."""
        mean = 0.5 * (self.xx + self.yy)
        half = jnp.sqrt(0.25 * (self.xx - self.yy) ** 2 + self.xy**2)
        least, most = mean - half, mean + half
        # If the eigenvalues have different signs, only the part of the positive one is kept.
        share = jnp.maximum(most, 0) / jnp.where(half > 0, 2 * half, 1)
        part = Symmetric(share * (self.xx - least), share * self.xy, share * (self.yy - least))
        return Symmetric(*(jnp.where(least >= 0, x, y) for x, y in zip(self, part, strict=True)))

    @property
    def inverse(self) -> Symmetric:
        """Their inverses."""
        determinant = self.xx * self.yy - self.xy**2
        return Symmetric(self.yy / determinant, -self.xy / determinant, self.xx / determinant)


class Square(NamedTuple):
    """Matrices of two rows."""

    xx: Float[Array, " n"]
    xy: Float[Array, " n"]
    yx: Float[Array, " n"]
    yy: Float[Array, " n"]


class EdgeBlocks(eqx.Module):
    r"""The blocks of the Hessian of the two ends of each edge.

    Conjugate gradients and MINRES take many iterations where the stiffness differs between neighbouring
    vertices: a short edge under tension resists rotation a thousand times more than a cell resists a change
    of its shape. So the 4 x 4 block of each edge is inverted, and the results are added (additive Schwarz
    method with overlapping subspaces of two vertices: Xu 1992, doi:10.1137/1034116).

    The blocks are those of the energy as a function of lengths $l$, areas $A$ and perimeters $P$,

    $$\sum_c \begin{pmatrix} \nabla A_c & \nabla P_c \end{pmatrix} K_c
    \begin{pmatrix} \nabla A_c & \nabla P_c \end{pmatrix}^T
    + \sum_e \left( T_e \nabla^2 l_e + l''_e \nabla l_e \nabla l_e^T \right),$$

    with the second derivatives $K_c$ and $l''_e$ of the energy and the tensions $T_e$, without negative
    eigenvalues and without the terms of pressures. A direct dependence of the energy on vertices, as of
    friction, counts by the mean of its second derivatives. So the blocks are positive definite whatever the
    Hessian is: they change the number of iterations, not the solution.
    """

    ends: EdgeEnds
    first: Symmetric
    """The block of the first end of each edge."""
    second: Symmetric
    """The block of the second end."""
    between: Square
    """The force on the first end for a displacement of the second end."""
    moves: Bool[Array, " vertices"] | None
    softest: Float[Array, ""]

    @classmethod
    def of(
        cls, tissue: Tissue, energy: AbstractEnergy, more: Symmetric | None = None
    ) -> EdgeBlocks | None:
        """The blocks of a tissue; None if its edges are arcs.

        **Arguments:**

        - `tissue`: the tissue.
        - `energy`: its energy.
        - `more`: additional stiffness of single vertices.
        """
        if tissue.arcs is not None:
            return None
        m, geometry = tissue.topology, tissue.measured()
        response = _Response.of(energy, tissue, geometry)
        diagonal, between = _resistances(tissue, response)
        mean = 0.5 * jnp.mean(diagonal.xx + diagonal.yy)
        softest = _SOFTEST * mean + _directly(tissue, energy, geometry)
        softest = jnp.where(softest > 0, softest, 1)
        if more is not None:
            diagonal = Symmetric(*(x + y for x, y in zip(diagonal, more, strict=True)))
        # (Rounding must not make a block indefinite, however stiff the edge.)
        rounding = 20 * jnp.finfo(mean.dtype).eps * (diagonal.xx + diagonal.yy)
        diagonal = diagonal.stiffened(rounding)
        ends = EdgeEnds.of(m)
        first, second = (Symmetric(*(take(x, end) for x in diagonal)) for end in ends.vertices)
        moves = None if tissue.held is None else ~tissue.held
        return cls(ends, first, second, between, moves, softest)

    def approximate_inverse(self, damping: Float[Array, " vertices"] | float = 0.0) -> EdgeInverse:
        """The inverse of the damped blocks."""
        damping = jnp.broadcast_to(damping, self.ends.slots.shape[1:])
        one, other = (take(damping, end) + self.softest for end in self.ends.vertices)
        b, p = self.between, self.first.stiffened(one).inverse
        # With the Schur complement of the first end.
        q = Square(
            p.xx * b.xx + p.xy * b.yx,
            p.xx * b.xy + p.xy * b.yy,
            p.xy * b.xx + p.yy * b.yx,
            p.xy * b.xy + p.yy * b.yy,
        )
        rest = self.second.stiffened(other)
        second = Symmetric(
            rest.xx - (b.xx * q.xx + b.yx * q.yx),
            rest.xy - (b.xx * q.xy + b.yx * q.yy),
            rest.yy - (b.xy * q.xy + b.yy * q.yy),
        ).inverse
        between = Square(
            -(q.xx * second.xx + q.xy * second.xy),
            -(q.xx * second.xy + q.xy * second.yy),
            -(q.yx * second.xx + q.yy * second.xy),
            -(q.yx * second.xy + q.yy * second.yy),
        )
        first = Symmetric(
            p.xx - (between.xx * q.xx + between.xy * q.xy),
            p.xy - (between.xx * q.yx + between.xy * q.yy),
            p.yy - (between.yx * q.yx + between.yy * q.yy),
        )
        return EdgeInverse(self.ends, first, second, between, self.moves)


class EdgeInverse(eqx.Module):
    """The inverse of `EdgeBlocks` for one damping."""

    ends: EdgeEnds
    first: Symmetric
    second: Symmetric
    between: Square
    moves: Bool[Array, " vertices"] | None

    def __call__(self, force: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """The displacement of vertices by forces on them."""
        x, y, to_x, to_y = self.ends.gather(force)
        a, b, c = self.first, self.second, self.between
        moved = self.ends.scatter_add(
            a.xx * x + a.xy * y + c.xx * to_x + c.xy * to_y,
            a.xy * x + a.yy * y + c.yx * to_x + c.yy * to_y,
            c.xx * x + c.yx * y + b.xx * to_x + b.xy * to_y,
            c.xy * x + c.yy * y + b.xy * to_x + b.yy * to_y,
        )
        # (Each vertex is an end of three edges.)
        moved = moved / 3
        return moved if self.moves is None else jnp.where(self.moves[:, None], moved, 0)


class _Response(NamedTuple):
    """Derivatives of an energy by lengths, areas and perimeters; second derivatives are not negative."""

    tension: Float[Array, " edges"]
    stretch: Float[Array, " edges"]
    area: Float[Array, " cells"]
    mixed: Float[Array, " cells"]
    perimeter: Float[Array, " cells"]

    @classmethod
    def of(cls, energy: AbstractEnergy, tissue: Tissue, geometry: Measurements) -> _Response:
        slope, change = jax.linearize(
            jax.grad(lambda geometry: energy(MeasuredTissue(tissue, geometry))), geometry
        )
        zero = jax.tree.map(jnp.zeros_like, geometry)
        # All areas at once, and so on: the terms of an energy are those of single cells and edges.
        along = lambda **one: change(zero._replace(**one))
        by_length = along(lengths=jnp.ones_like(geometry.lengths))
        by_area = along(areas=jnp.ones_like(geometry.areas))
        by_perimeter = along(perimeters=jnp.ones_like(geometry.perimeters))
        finite = lambda x: jnp.where(jnp.isfinite(x), x, 0)
        positive = lambda x: jnp.maximum(finite(x), 0)
        area, perimeter = positive(by_area.areas), positive(by_perimeter.perimeters)
        most = jnp.sqrt(area * perimeter)
        mixed = jnp.clip(finite(by_area.perimeters), -most, most)
        sides = tissue.topology.edge_cells.T
        tension = slope.lengths + total(_of_cells(slope.perimeters, side) for side in sides)
        return cls(positive(tension), positive(by_length.lengths), area, mixed, perimeter)


def _resistances(tissue: Tissue, response: _Response) -> tuple[Symmetric, Square]:
    """The blocks of single vertices, and those between the two ends of each edge."""
    m = tissue.topology
    vectors = tissue.edge_vectors.T
    length = jnp.sqrt(total(vectors**2) + tissue.softening**2)
    length = jnp.where(length > 0, length, 1)
    unit = vectors / length
    stiff = response.tension / length
    of_edges = Symmetric(
        *(
            (stiff if i == j else 0) + (response.stretch - stiff) * unit[i] * unit[j]
            for i, j in _PAIRS
        )
    )
    # Of each corner of a cell: the gradients of its area and perimeter, and those times K.
    areas, perimeters = _corners(m, vectors, unit)
    by_area, mixed, by_perimeter = (
        _of_cells(x, m.cell) for x in (response.area, response.mixed, response.perimeter)
    )
    pull = [by_area * a + mixed * p for a, p in zip(areas, perimeters, strict=True)]
    drag = [mixed * a + by_perimeter * p for a, p in zip(areas, perimeters, strict=True)]

    def at_vertices(i: int, j: int, edges: Float[Array, " edges"]) -> Float[Array, " vertices"]:
        each = pull[i] * areas[j] + drag[i] * perimeters[j] + take(edges, m.edge)
        return total(each[slot::3] for slot in range(3))

    diagonal = Symmetric(*(at_vertices(*pair, x) for pair, x in zip(_PAIRS, of_edges, strict=True)))
    forward, backward = m.half_edge, take(m.twin, m.half_edge)
    # (A cell's corner at the second end comes after the one at the first, or before it.)
    sides = ((forward, take(m.next, forward)), (take(m.next, backward), backward))
    both = [
        total(
            take(pull[i], one) * take(areas[j], other)
            + take(drag[i], one) * take(perimeters[j], other)
            for one, other in sides
        )
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    xx, xy, yx, yy = both
    return diagonal, Square(xx - of_edges.xx, xy - of_edges.xy, yx - of_edges.xy, yy - of_edges.yy)


_PAIRS = ((0, 0), (0, 1), (1, 1))


def _corners(
    m: Topology, vectors: Float[Array, "2 edges"], unit: Float[Array, "2 edges"]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """The gradients of a cell's area, and of its perimeter, where each half-edge begins."""
    half_edges = lambda x: jnp.where(m.forward, take(x, m.edge), -take(x, m.edge))
    (x, y), (ux, uy) = map(half_edges, vectors), map(half_edges, unit)
    before = lambda x: take(x, m.previous)
    area = 0.5 * (y + before(y)), -0.5 * (x + before(x))
    return area, (before(ux) - ux, before(uy) - uy)


def _of_cells(values: Float[Array, " cells"], cells: Array) -> Array:
    # (The exterior has no energy.)
    return values.at[cells].get(mode="fill", fill_value=0)


def _directly(tissue: Tissue, energy: AbstractEnergy, geometry: Measurements) -> Float[Array, ""]:
    """The mean second derivative by vertices at fixed lengths, areas and perimeters."""
    # (Zero for most energies; JAX then compiles nothing.)
    slope = jax.grad(
        lambda vertices: energy(MeasuredTissue(tissue.with_vertices(vertices), geometry))
    )
    direction = probe_vector(tissue.vertices)
    _, response = jax.jvp(slope, (tissue.vertices,), (direction,))
    mean = jnp.sum(direction * response) / jnp.sum(direction**2)
    return jnp.where(jnp.isfinite(mean), jnp.maximum(mean, 0), 0)
