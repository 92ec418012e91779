"""What a step in time minimises."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.energies import AbstractEnergy
from vertax.energies._units import cell_size
from vertax.mesh import Tissue
from vertax.mesh._topology import edge_neighbourhood, source, take
from vertax.relax._inversion_barrier import REACH, inversion_energy_of_all


class Incremental(AbstractEnergy):
    """The energy at the end of a step, and what the step dissipates.

    **Arguments:**

    - `energy`: that of the tissue, less the work of what drives it.
    - `dissipation`: what resists.
    - `before`: where the step begins.
    - `dt`: its length.
    - `strained`: strains that an earlier stage of the step is to be extrapolated by, for second order.
    - `flips`: whether edges may flip in the step.
    - `pressed`: the largest force of what drives the tissue, if anything does.
    """

    energy: AbstractEnergy
    dissipation: AbstractDissipation
    before: Tissue
    dt: Float[Array, ""]
    strained: Float[Array, " strains"] | None = None
    flips: bool = eqx.field(static=True, default=True)
    pressed: Float[Array, ""] | None = None

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The incremental potential."""
        before = flipped_as(self.before, tissue) if self.flips else self.before
        value = self.energy(tissue)
        if self.pressed is not None:
            reach = REACH * cell_size(self.before)
            value += inversion_energy_of_all(tissue, reach, self.pressed)
        if self.strained is None or not isinstance(self.dissipation, AbstractViscosity):
            return value + self.dissipation(tissue, before, self.dt)
        strains = self.dissipation.strains(tissue, before) - self.strained
        return value + 0.5 * jnp.sum(strains**2) / self.dt


def flipped_as(before: Tissue, tissue: Tissue) -> Tissue:
    """Where a step begins, with the edges flipped that flip in it, each about its middle.

    A T1 turns an edge at once, and nothing resists that: what a step dissipates counts from the turned edge.
    Otherwise friction would forbid transitions in steps so short that no edge shrinks to nothing in one.
    """
    m = before.topology
    h = m.half_edge
    t, a, _, c, _ = edge_neighbourhood(m)
    ends = take(m.cell, jnp.stack([a, c], axis=-1))  # the cells that a flip makes neighbours
    now = tissue.topology.edge_cells
    flipped = jnp.all(now == ends, axis=-1) | jnp.all(now == ends[:, ::-1], axis=-1)
    vector = before.edge_vectors
    turned = jnp.stack([vector[:, 1], -vector[:, 0]], axis=-1)  # clockwise, as a T1 does
    half = jnp.where(flipped[:, None], 0.5 * (turned - vector), 0)
    vertices = before.vertices.at[source(h)].add(-half).at[source(t)].add(half)
    placed = before.with_vertices(vertices)
    # (A tissue with spare slots may have lost a cell as well: that is no flip.)
    return placed if m.spare else placed.with_topology(tissue.topology)
