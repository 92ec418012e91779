"""Exchange of amounts along edges, and the amounts of cells that vanish."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.arcs import length_factor
from vertax._base.half_edges import clockwise
from vertax._base.indexing import take
from vertax.mesh import Tissue


class Exchange(NamedTuple):
    r"""The exchange between neighbours: the flux into cell $i$ is $D \ell_{ij} / d_{ij} (c_j - c_i)$."""

    cells: Int[Array, "edges 2"]
    """The cells on the left and the right of each edge; `n_cells` or more for other faces."""
    conductance: Float[Array, " edges"]
    r"""$\ell_{ij} / d_{ij}$; 0 for edges on the outline and of spare slots."""

    @classmethod
    def of(cls, tissue: Tissue) -> Exchange:
        """The exchange in a tissue: edge lengths and distances of centroids, in space on a surface."""
        m, centroids = tissue.topology, tissue.centroids
        cells = m.edge_cells
        inside = jnp.all(cells < tissue.n_cells, axis=-1)
        left, right = (
            centroids.at[cells[:, side]].get(mode="fill", fill_value=0) for side in (0, 1)
        )
        # The corner of both cells at the start of an edge is in the frame of each of them.
        frames = take(m.frame, m.half_edge) - take(m.frame, clockwise(m.half_edge))
        right = right + tissue.boundary.translation(frames)
        if tissue.surface is not None:
            left, right = (tissue.surface.points(x).astype(x.dtype) for x in (left, right))
        distances = _norm(right - left)
        apart = inside & (distances > 0)
        return cls(cells, jnp.where(apart, _lengths(tissue) / jnp.where(apart, distances, 1), 0))

    def flux(
        self, concentrations: Float[Array, "species cells"], diffusion: Float[Array, " species"]
    ) -> Float[Array, "species cells"]:
        """The amount that each cell gains per time; the sum over the cells is 0 to rounding."""
        ends = concentrations.at[:, self.cells].get(mode="fill", fill_value=0)
        diffusion = diffusion.astype(concentrations.dtype)
        flux = diffusion[:, None] * self.conductance * (ends[..., 1] - ends[..., 0])
        gains = jnp.stack([flux, -flux], axis=-1)
        return jnp.zeros_like(concentrations).at[:, self.cells].add(gains, mode="drop")


def redistributed(
    amounts: Float[Array, "species cells"], before: Tissue, tissue: Tissue
) -> Float[Array, "species cells"]:
    """The amounts after a step in which cells may have vanished.

    Living former neighbours share the amount of a cell in proportion to the lengths of their edges before the
    step; without one all living cells do, in proportion to their areas.
    """
    cells, lives = before.topology.edge_cells, tissue.alive
    died = before.alive & ~lives
    source, target = jnp.concatenate([cells, cells[:, ::-1]]).T
    some = lambda mask, index: mask.at[index].get(mode="fill", fill_value=False)
    lengths = jnp.where(some(died, source) & some(lives, target), jnp.tile(_lengths(before), 2), 0)
    totals = jnp.zeros(tissue.n_cells, lengths.dtype).at[source].add(lengths, mode="drop")
    shares = jnp.where(died, amounts, 0) / jnp.where(totals > 0, totals, 1)
    shares = shares.at[:, source].get(mode="fill", fill_value=0) * lengths
    kept = jnp.where(lives, amounts, 0).at[:, target].add(shares, mode="drop")
    areas = jnp.where(lives, tissue.areas, 0)
    lost = jnp.sum(jnp.where(died & (totals == 0), amounts, 0), axis=-1, keepdims=True)
    return kept + lost * areas / jnp.sum(areas)


def _lengths(tissue: Tissue) -> Float[Array, " edges"]:
    """The lengths of edges without softening: 0 for an edge in a T1 transition, and for spare slots."""
    lengths = _norm(tissue.edge_chords)
    if tissue.arcs is not None:
        lengths = lengths * length_factor(tissue.edge_angles)
    m = tissue.topology
    return jnp.where(m.alive_edges, lengths, 0) if m.spare else lengths


def _norm(vectors: Float[Array, "edges axes"]) -> Float[Array, " edges"]:
    """The norm, with the derivative 0 at 0."""
    squared = jnp.sum(vectors**2, axis=-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
