"""A preconditioner that knows what a tissue is in the small: edges, with the cells around them."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.probe import probe
from vertax._base.sums import total
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._ends import Ends
from vertax.mesh._measured import Measured
from vertax.mesh._tissue import Known
from vertax.mesh._topology import source, take


class Symmetric(NamedTuple):
    """Symmetric matrices of two rows."""

    xx: Float[Array, " n"]
    xy: Float[Array, " n"]
    yy: Float[Array, " n"]

    def with_diagonal(self, more: Float[Array, " n"]) -> Symmetric:
        return Symmetric(self.xx + more, self.xy, self.yy + more)

    @property
    def inverse(self) -> Symmetric:
        determinant = self.xx * self.yy - self.xy**2
        return Symmetric(self.yy / determinant, -self.xy / determinant, self.xx / determinant)


class Square(NamedTuple):
    """Matrices of two rows."""

    xx: Float[Array, " n"]
    xy: Float[Array, " n"]
    yx: Float[Array, " n"]
    yy: Float[Array, " n"]


class EdgeBlocks(eqx.Module):
    r"""The Hessian of a tissue as the two ends of each edge know it, all other vertices held.

    Of an energy of lengths $l$, areas $A$ and perimeters $P$ it takes

    $$\sum_c K_c \text{ in } (\nabla A_c, \nabla P_c) + \sum_e T_e \nabla^2 l_e + l''_e \nabla l_e \nabla l_e^T$$

    """

    ends: Ends
    first: Symmetric
    second: Symmetric
    between: Square
    moves: Bool[Array, " vertices"] | None
    softest: Float[Array, ""]

    @classmethod
    def of(cls, tissue: Tissue, energy: AbstractEnergy) -> EdgeBlocks:
        m = tissue.topology
        known = tissue.measured()
        slopes = jax.grad(lambda known: energy(Measured(tissue, known)))
        slope, change = jax.linearize(slopes, known)
        ones, zeros = jax.tree.map(jnp.ones_like, known), jax.tree.map(jnp.zeros_like, known)
        along = lambda name: change(zeros._replace(**{name: getattr(ones, name)}))
        by_area, by_perimeter = along("areas"), along("perimeters")
        sound = lambda x: jnp.where(jnp.isfinite(x), jnp.maximum(x, 0), 0)
        a, p = sound(by_area.areas), sound(by_perimeter.perimeters)
        most = jnp.sqrt(a * p)
        b = jnp.clip(jnp.where(jnp.isfinite(by_area.perimeters), by_area.perimeters, 0), -most, most)
        of_cell = lambda x, h: x.at[take(m.cell, h)].get(mode="fill", fill_value=0)
        h = jnp.arange(m.n_half_edges, dtype=m.twin.dtype)
        stretch = sound(along("lengths").lengths)
        tension = slope.lengths + total(
            slope.perimeters.at[m.edge_cells[:, k]].get(mode="fill", fill_value=0) for k in (0, 1)
        )
        # Half-edges
        vectors = tissue.edge_vectors
        length = jnp.sqrt(jnp.sum(vectors**2, axis=-1) + tissue.softening**2)
        unit = vectors / length[:, None]
        stiff = sound(tension) / length
        forward = lambda x: jnp.where(m.forward, x, -x)
        vx, vy = (forward(take(vectors[:, k], m.edge)) for k in (0, 1))
        ux, uy = (forward(take(unit[:, k], m.edge)) for k in (0, 1))
        before = lambda x: take(x, m.previous)
        area = 0.5 * (vy + before(vy)), -0.5 * (vx + before(vx))
        perimeter = before(ux) - ux, before(uy) - uy
        aa, ab, pp = (of_cell(x, h) for x in (a, b, p))
        left = [aa * area[k] + ab * perimeter[k] for k in (0, 1)]
        right = [ab * area[k] + pp * perimeter[k] for k in (0, 1)]

        def corners(i: Array, j: Array, r: int, s: int) -> Array:
            return take(left[r], i) * take(area[s], j) + take(right[r], i) * take(perimeter[s], j)

        own = [
            stiff * (1 - unit[:, 0] ** 2) + stretch * unit[:, 0] ** 2,
            (stretch - stiff) * unit[:, 0] * unit[:, 1],
            stiff * (1 - unit[:, 1] ** 2) + stretch * unit[:, 1] ** 2,
        ]
        pairs = ((0, 0), (0, 1), (1, 1))
        diagonal = [
            left[r] * area[s] + right[r] * perimeter[s] + take(own[k], m.edge)
            for k, (r, s) in enumerate(pairs)
        ]
        diagonal = [jnp.sum(x.reshape(-1, 3), axis=1) for x in diagonal]
        mean = 0.5 * jnp.mean(diagonal[0] + diagonal[2])
        direct = _direct(tissue, energy, known)
        first_end, second_end = m.half_edge, take(m.twin, m.half_edge)
        i, j = source(first_end), source(second_end)
        nexts = take(m.next, first_end), take(m.next, second_end)
        between = [
            corners(first_end, nexts[0], r, s) + corners(nexts[1], second_end, r, s) - own[k]
            for (r, s), k in (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2))
        ]
        eps = 20 * jnp.finfo(mean.dtype).eps

        def end(v: Array) -> Symmetric:
            block = Symmetric(*(take(x, v) for x in diagonal))
            return block.with_diagonal(eps * (block.xx + block.yy) + direct)

        moves = None if tissue.held is None else ~tissue.held
        return cls(Ends.of(m), end(i), end(j), Square(*between), moves, _SOFTEST * mean)

    def compliance(self, shift: Float[Array, " vertices"]) -> EdgeCompliance:
        x, y, b = self.first, self.second, self.between
        i, j = (take(shift, end) for end in self.ends.vertices)
        p = x.with_diagonal(i + self.softest).inverse
        # P B
        q = Square(
            p.xx * b.xx + p.xy * b.yx,
            p.xx * b.xy + p.xy * b.yy,
            p.xy * b.xx + p.yy * b.yx,
            p.xy * b.xy + p.yy * b.yy,
        )
        y = y.with_diagonal(j + self.softest)
        second = Symmetric(
            y.xx - (b.xx * q.xx + b.yx * q.yx),
            y.xy - (b.xx * q.xy + b.yx * q.yy),
            y.yy - (b.xy * q.xy + b.yy * q.yy),
        ).inverse
        s = second
        c = Square(
            -(q.xx * s.xx + q.xy * s.xy),
            -(q.xx * s.xy + q.xy * s.yy),
            -(q.yx * s.xx + q.yy * s.xy),
            -(q.yx * s.xy + q.yy * s.yy),
        )
        first = Symmetric(
            p.xx - (c.xx * q.xx + c.xy * q.xy),
            p.xy - (c.xx * q.yx + c.xy * q.yy),
            p.yy - (c.yx * q.yx + c.yy * q.yy),
        )
        return EdgeCompliance(self.ends, first, second, c, self.moves)


class EdgeCompliance(eqx.Module):
    ends: Ends
    first: Symmetric
    second: Symmetric
    between: Square
    moves: Bool[Array, " vertices"] | None

    def __call__(self, force: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        x, y, to_x, to_y = self.ends.look(force)
        a, b, c = self.first, self.second, self.between
        out = self.ends.back(
            a.xx * x + a.xy * y + c.xx * to_x + c.xy * to_y,
            a.xy * x + a.yy * y + c.yx * to_x + c.yy * to_y,
            c.xx * x + c.yx * y + b.xx * to_x + b.xy * to_y,
            c.xy * x + c.yy * y + b.xy * to_x + b.yy * to_y,
        )
        out = out / 3
        return out if self.moves is None else jnp.where(self.moves[:, None], out, 0)


import os
_SOFTEST = float(os.environ.get("SOFT","1e-2"))


def _direct(tissue: Tissue, energy: AbstractEnergy, known: Known) -> Float[Array, ""]:
    slope = jax.grad(lambda vertices: energy(Measured(tissue.with_vertices(vertices), known)))
    direction = probe(tissue.vertices)
    _, response = jax.jvp(slope, (tissue.vertices,), (direction,))
    return jnp.maximum(jnp.sum(direction * response) / jnp.sum(direction**2), 0)
