"""The incremental potential, which a time step minimises."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.half_edges import source
from vertax._base.indexing import take
from vertax._base.model_checks import real_scalar
from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.mesh._topology import edge_neighbourhood
from vertax.relax._inversion_barrier import REACH, inversion_energy_of_all


class IncrementalPotential(AbstractEnergy):
    r"""$E(x) + \Delta t\, R((x - x_0) / \Delta t; x_0)$, plus an inversion barrier if the tissue is driven.

    **Arguments:**

    - `energy`: the energy of the tissue minus the work of the driving forces.
    - `dissipation`: the dissipation $R$.
    - `before`: the tissue $x_0$ at the start of the step.
    - `dt`: the time step $\Delta t$.
    - `previous_strains`: for order 2, strains of the earlier stage that are subtracted from those of this
        stage.
    - `may_flip`: whether edges may flip in the step.
    - `max_driving_force`: the largest driving force; None without a drive.
    """

    energy: AbstractEnergy
    dissipation: AbstractDissipation
    before: Tissue
    dt: Float[Array, ""]
    previous_strains: Float[Array, " strains"] | None = None
    may_flip: bool = eqx.field(static=True, default=True)
    max_driving_force: Float[Array, ""] | None = None

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The incremental potential."""
        before = with_flips_of(self.before, tissue) if self.may_flip else self.before
        value = real_scalar(self.energy(tissue))
        if self.max_driving_force is not None:
            reach = REACH * self.before.cell_size
            value += inversion_energy_of_all(tissue, reach, self.max_driving_force)
        if self.previous_strains is None or not isinstance(self.dissipation, AbstractViscosity):
            return value + self.dissipation(tissue, before, self.dt)
        strains = self.dissipation.strains(tissue, before) - self.previous_strains
        return value + 0.5 * jnp.sum(strains**2) / self.dt


def with_flips_of(before: Tissue, tissue: Tissue) -> Tissue:
    """The tissue at the start of a step, with the T1 flips of the step applied by rotation about midpoints.

    A T1 rotates an edge instantaneously and without dissipation: the dissipation of the step is measured from
    the rotated edge. Otherwise friction would forbid transitions in short time steps.
    """
    m = before.topology
    h = m.half_edge
    t, a, _, c, _ = edge_neighbourhood(m)
    ends = take(m.cell, jnp.stack([a, c], axis=-1))  # the cells that a flip makes neighbours
    sides = tissue.topology.edge_cells
    flipped = jnp.all(sides == ends, axis=-1) | jnp.all(sides == ends[:, ::-1], axis=-1)
    vector = before.edge_vectors
    rotated = jnp.stack([vector[:, 1], -vector[:, 0]], axis=-1)  # clockwise, as a T1 does
    half = jnp.where(flipped[:, None], 0.5 * (rotated - vector), 0)
    vertices = before.vertices.at[source(h)].add(-half).at[source(t)].add(half)
    moved = before.with_vertices(vertices)
    # (With spare slots the topology may also differ by a removed cell, which is not a flip.)
    return moved if m.spare else moved.with_topology(tissue.topology)
