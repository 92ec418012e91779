"""The barrier of short edges against inversion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.indexing import take
from vertax._base.reductions import indices_of_true
from vertax._base.sums import total
from vertax.mesh import Tissue, Topology
from vertax.mesh._topology import edge_neighbourhood
from vertax.relax._barrier import (
    FLOOR,
    AbstractBarrier,
    Expansion,
    GatherPlan,
    barrier_energy,
    composed,
    outer,
    profile,
)

REACH = 2e-3
"""The range $r$ of the barrier, in units of the size of a cell."""
_FADE = 8.0
"""The length from which on the barrier is zero, in units of its range."""


class InversionBarrier(AbstractBarrier):
    r"""The barrier of short edges against inversion.

    If forces press the ends of an edge together whether it has flipped or not, four cells meet in a point.
    The energy would be least where the edge points the wrong way. With the edge vector $u$, its length
    $\sqrt s$ and the unit vector $n$ in which it must point, the energy is $F r f(s) \varphi(w)$ with
    $w = (\sqrt s + u \cdot n) / 2 r$, the barrier $\varphi$ of contacts and a factor $f$ that is 0 for long
    edges. It is on only for edges that have been inverted repeatedly.

    **Arguments:**

    - `edges`: the numbers of edges with the barrier on; the number of edges in unused rows.
    - `counts`: how often each edge was inverted.
    - `reach`: the range $r$, a length.
    - `force`: the scale $F$ of the force.
    """

    edges: Int[Array, " some"]
    counts: Int[Array, " edges"]
    reach: Float[Array, ""]
    force: Float[Array, ""]

    @classmethod
    def empty(
        cls, tissue: Tissue, reach: Float[Array, ""], force: Float[Array, ""]
    ) -> InversionBarrier:
        """The barrier of no edge."""
        n = tissue.n_edges
        some = min(n, max(_FEWEST, n // _SHARE))
        unused = jnp.full(some, n, tissue.topology.edge.dtype)
        return cls(unused, jnp.zeros(n, jnp.int32), reach, force)

    @property
    def any(self) -> Bool[Array, ""]:
        """Whether the barrier of any edge is on."""
        return jnp.any(self.edges < len(self.counts))

    @property
    def held(self) -> Bool[Array, " edges"]:
        """The edges with the barrier on."""
        return jnp.zeros(len(self.counts), bool).at[self.edges].set(True, mode="drop")

    def plan(self, topology: Topology) -> GatherPlan:
        """The two ends of each edge, and the far ends of its four neighbours, in one frame."""
        m = topology
        edges = jnp.minimum(self.edges, m.n_edges - 1)
        _, *neighbours = edge_neighbourhood(m, edges)
        leaving = jnp.stack([take(m.half_edge, edges), *neighbours])
        sources, targets = GatherPlan.of(m, leaving), GatherPlan.of(m, take(m.next, leaving))
        start, end = sources.images[:1], targets.images[:1]
        offsets = targets.images - sources.images
        images = [start, end, start + offsets[1:3], end + offsets[3:]]
        vertices = jnp.concatenate([sources.vertices[:1], targets.vertices])
        return GatherPlan(vertices, jnp.concatenate(images))

    def vectors(self, positions: Float[Array, "6 some 2"]) -> Float[Array, "4 some"]:
        """The edge, and the direction in which it must point, of the points of `plan`."""
        start, end, a, b, c, d = positions
        # (Of `edge_axis`, in which the ends of the edge cancel.)
        return jnp.concatenate([end - start, c + d - a - b], axis=-1).T

    def forces(self, slopes: Float[Array, "4 some"]) -> Float[Array, "6 some 2"]:
        """The transpose of `vectors`."""
        edge, axis = slopes[:2].T, slopes[2:].T
        return jnp.stack([-edge, edge, -axis, -axis, axis, axis])

    def expansion(self, vectors: Float[Array, "4 some"]) -> Expansion:
        """The energy of each row, $F r\\, f(s)\\, \\varphi(w)$, and its derivatives."""
        u, a = vectors[:2], vectors[2:]
        s = total(u * u)
        squared = total(a * a)
        axis = jax.lax.rsqrt(jnp.where(squared > 0, squared, 1))
        n = a * axis
        root = jax.lax.rsqrt(s + (FLOOR * self.reach) ** 2)
        along = total(u * n)
        half = 0.5 / self.reach
        w = half * ((s + (FLOOR * self.reach) ** 2) * root + along)
        scale = 1 / (_FADE * self.reach) ** 2
        fade = jnp.maximum(1 - scale * s, 0)
        f, df, ddf = fade**3, -3 * scale * fade**2, 6 * scale**2 * fade
        b = profile(w)
        strength = jnp.where(self.edges < len(self.counts), self.force * self.reach, 0)
        zero = jnp.zeros_like(u)
        eye = jnp.eye(2, dtype=u.dtype)[:, :, None]
        across = eye - outer(n, n)
        pull = total(across[:, j] * u[j] for j in range(2))  # u less its part along the axis
        uu = half * (eye * root - outer(u, u) * root**3)
        ua = half * axis * across
        aa = -half * axis**2 * (along * across + outer(pull, n) + outer(n, pull))
        wide = lambda uu, ua, aa: jnp.concatenate(
            [jnp.concatenate([uu, ua], 1), jnp.concatenate([ua, aa], 1)]
        )
        zeros = jnp.zeros_like(across)
        return composed(
            strength * f * b.value,
            (strength * df * b.value, strength * f * b.first),
            (strength * ddf * b.value, strength * df * b.first, strength * f * b.second),
            (
                jnp.concatenate([2 * u, zero]),
                half * jnp.concatenate([u * root + n, axis * pull]),
            ),
            (wide(2 * eye + zeros, zeros, zeros), wide(uu, ua, aa)),
        )

    def updated(
        self, turned: Bool[Array, " edges"], squared: Float[Array, " edges"]
    ) -> InversionBarrier:
        """With edges that were inverted, and without those that have grown.

        **Arguments:**

        - `turned`: which edges were inverted.
        - `squared`: their squared lengths.
        """
        n = turned.size
        counts = self.counts + turned
        held = self.held & (squared < (_LONG * self.reach) ** 2)
        held |= turned & (counts >= _OFTEN)
        edges, valid = indices_of_true(held, len(self.edges))
        edges = jnp.where(valid, edges, n)
        return InversionBarrier(edges.astype(self.edges.dtype), counts, self.reach, self.force)


_LONG = 4 * _FADE
"""The length at which the barrier of an edge turns off, in units of its range: a step could invert a shorter
edge again."""
_OFTEN = 8
"""The number of inversions that turns the barrier on: edges under high tension often invert in passing."""
_FEWEST, _SHARE = 16, 256
"""The number of rows: 16, or the number of edges over 256."""


def inversion_energy_of_all(
    tissue: Tissue, reach: Float[Array, ""], force: Float[Array, ""]
) -> Array:
    """The energy of the barrier of all edges."""
    edges = jnp.arange(tissue.n_edges, dtype=tissue.topology.edge.dtype)
    every = InversionBarrier(edges, jnp.zeros_like(edges), reach, force)
    return barrier_energy(every, every.plan(tissue.topology).positions(tissue))
