"""A preconditioner that knows what a tissue is in the small: each edge with its two ends."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.probe_vector import probe_vector
from vertax._base.sums import total
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._edge_ends import EdgeEnds
from vertax.mesh._measured_tissue import MeasuredTissue
from vertax.mesh._tissue import Measurements
from vertax.mesh._topology import Topology, take

# What a block resists with at least, in units of the mean of all. (From a tenth to three times of that the
# steps are as many.)
_SOFTEST = 1e-2


class Symmetric(NamedTuple):
    """Symmetric matrices of two rows."""

    xx: Float[Array, " n"]
    xy: Float[Array, " n"]
    yy: Float[Array, " n"]

    def stiffened(self, more: Float[Array, "*n"]) -> Symmetric:
        """With more on the diagonal."""
        return Symmetric(self.xx + more, self.xy, self.yy + more)

    @property
    def positive(self) -> Symmetric:
        """Without what is negative in them."""
        mean = 0.5 * (self.xx + self.yy)
        half = jnp.sqrt(0.25 * (self.xx - self.yy) ** 2 + self.xy**2)
        least, most = mean - half, mean + half
        # Of two eigenvalues of different sign only the larger one stays, with its own direction.
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
    r"""The Hessian of a tissue, as far as the two ends of each edge feel it while all others stay.

    Conjugate gradients and MINRES take many steps where neighbouring vertices resist very differently: a
    short edge under tension resists a turn a thousand times as much as a cell a change of its shape. So each
    edge gives way on its own, its two ends together, and what all edges say of a vertex is added. (Additive
    Schwarz method: Xu 1992, doi:10.1137/1034116, with subspaces of two vertices that overlap.)

    Blocks are those of the energy as a function of lengths $l$, areas $A$ and perimeters $P$,

    $$\sum_c \begin{pmatrix} \nabla A_c & \nabla P_c \end{pmatrix} K_c
    \begin{pmatrix} \nabla A_c & \nabla P_c \end{pmatrix}^T
    + \sum_e \left( T_e \nabla^2 l_e + l''_e \nabla l_e \nabla l_e^T \right),$$

    with the second derivatives $K_c$ and $l''_e$ of the energy and the tensions $T_e$, each made positive
    (and without pressures). What an energy says of vertices directly, as friction does, counts by its
    mean. So blocks are positive definite whatever the Hessian is, and change the number of steps and not
    where they lead.
    """

    ends: EdgeEnds
    first: Symmetric
    """How each first end resists if it moves alone,"""
    second: Symmetric
    """and the second one;"""
    between: Square
    """which force on the first end comes of the second one's motion."""
    moves: Bool[Array, " vertices"] | None
    softest: Float[Array, ""]

    @classmethod
    def of(
        cls, tissue: Tissue, energy: AbstractEnergy, more: Symmetric | None = None
    ) -> EdgeBlocks | None:
        """Those of a tissue as it is now; None if edges are arcs, which give way with their angles.

        **Arguments:**

        - `tissue`: the tissue.
        - `energy`: its energy.
        - `more`: how vertices resist besides, each on its own.
        """
        if tissue.arcs is not None:
            return None
        m, known = tissue.topology, tissue.measured()
        response = _Response.of(energy, tissue, known)
        diagonal, between = _resistances(tissue, response)
        mean = 0.5 * jnp.mean(diagonal.xx + diagonal.yy)
        softest = _SOFTEST * mean + _directly(tissue, energy, known)
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

    def compliance(self, shift: Float[Array, " vertices"] | float = 0.0) -> EdgeCompliance:
        """How edges give way if a spring of stiffness `shift` holds each vertex besides."""
        shift = jnp.broadcast_to(shift, self.ends.slots.shape[1:])
        one, other = (take(shift, end) + self.softest for end in self.ends.vertices)
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
        return EdgeCompliance(self.ends, first, second, between, self.moves)


class EdgeCompliance(eqx.Module):
    """How edges give way to forces on vertices."""

    ends: EdgeEnds
    first: Symmetric
    second: Symmetric
    between: Square
    moves: Bool[Array, " vertices"] | None

    def __call__(self, force: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """How they give way to forces on vertices."""
        x, y, to_x, to_y = self.ends.gather(force)
        a, b, c = self.first, self.second, self.between
        moved = self.ends.scatter_add(
            a.xx * x + a.xy * y + c.xx * to_x + c.xy * to_y,
            a.xy * x + a.yy * y + c.yx * to_x + c.yy * to_y,
            c.xx * x + c.yx * y + b.xx * to_x + b.xy * to_y,
            c.xy * x + c.yy * y + b.xy * to_x + b.yy * to_y,
        )
        # Three edges speak of each vertex.
        moved = moved / 3
        return moved if self.moves is None else jnp.where(self.moves[:, None], moved, 0)


class _Response(NamedTuple):
    """How an energy answers to changes of what it asks of a tissue, nowhere softer than nothing."""

    tension: Float[Array, " edges"]
    stretch: Float[Array, " edges"]
    area: Float[Array, " cells"]
    mixed: Float[Array, " cells"]
    perimeter: Float[Array, " cells"]

    @classmethod
    def of(cls, energy: AbstractEnergy, tissue: Tissue, known: Measurements) -> _Response:
        slope, change = jax.linearize(
            jax.grad(lambda known: energy(MeasuredTissue(tissue, known))), known
        )
        none = jax.tree.map(jnp.zeros_like, known)
        # All areas at once, and so on: the terms of an energy are those of single cells and edges.
        along = lambda **one: change(none._replace(**one))
        by_length = along(lengths=jnp.ones_like(known.lengths))
        by_area = along(areas=jnp.ones_like(known.areas))
        by_perimeter = along(perimeters=jnp.ones_like(known.perimeters))
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
    own = Symmetric(
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

    def around(i: int, j: int, edges: Float[Array, " edges"]) -> Float[Array, " vertices"]:
        each = pull[i] * areas[j] + drag[i] * perimeters[j] + take(edges, m.edge)
        return total(each[slot::3] for slot in range(3))

    diagonal = Symmetric(*(around(*pair, x) for pair, x in zip(_PAIRS, own, strict=True)))
    here, there = m.half_edge, take(m.twin, m.half_edge)
    # (A cell's corner at the second end comes after the one at the first, or before it.)
    sides = ((here, take(m.next, here)), (take(m.next, there), there))
    both = [
        total(
            take(pull[i], one) * take(areas[j], other)
            + take(drag[i], one) * take(perimeters[j], other)
            for one, other in sides
        )
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    xx, xy, yx, yy = both
    return diagonal, Square(xx - own.xx, xy - own.xy, yx - own.xy, yy - own.yy)


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


def _directly(tissue: Tissue, energy: AbstractEnergy, known: Measurements) -> Float[Array, ""]:
    """The mean resistance to motions of vertices that change nothing else that is known."""
    # (Mostly there is none, and JAX knows it.)
    slope = jax.grad(lambda vertices: energy(MeasuredTissue(tissue.with_vertices(vertices), known)))
    direction = probe_vector(tissue.vertices)
    _, response = jax.jvp(slope, (tissue.vertices,), (direction,))
    mean = jnp.sum(direction * response) / jnp.sum(direction**2)
    return jnp.where(jnp.isfinite(mean), jnp.maximum(mean, 0), 0)
