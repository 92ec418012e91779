"""Self-propelled cells."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from vertax._base.checks import as_real, check_number, check_shape
from vertax._base.model_checks import check_planar
from vertax.activities._activity import AbstractActivity
from vertax.activities._noise import safe_sqrt
from vertax.activities._push import Push
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class PropulsionState(eqx.Module):
    """The state of [`SelfPropulsion`][vertax.activities.SelfPropulsion]."""

    angles: Float[Array, " cells"]
    """The direction of each cell, in radians."""
    displacement: Float[Array, "vertices 2"]
    """The motion of the vertices in the previous step."""


class SelfPropulsion(AbstractActivity):
    r"""Self-propulsion with rotational diffusion and velocity alignment.

    Each cell has a force of constant magnitude along the direction $\theta$ with

    $$\dot\theta = J \sin(\phi - \theta) + \sqrt{2 D_r}\, \eta(t),$$

    where $\phi$ is the direction of motion of the cell in the previous step and $\eta$ is white noise. The
    force is divided equally among the vertices of the cell. (Bi et al. 2016,
    doi:10.1103/PhysRevX.6.021011, for Voronoi tissues.)

    **Arguments:**

    - `force`: the magnitude of the force; a scalar or one per cell.
    - `rotational_diffusion`: $D_r$, inverse time.
    - `alignment`: $J$, inverse time.

    **Raises:**

    - `ValueError` for negative numbers, and in a step for a force of the wrong shape or a tissue on a
        surface, where directions at different places cannot be compared.
    """

    force: Float[Array, "*cells"]
    rotational_diffusion: Float[Array, ""]
    alignment: Float[Array, ""]

    def __init__(
        self, force: ArrayLike, rotational_diffusion: ArrayLike = 1.0, alignment: ArrayLike = 0.0
    ):
        check_number("force", force, at_least=0, many=True)
        check_number("rotational_diffusion", rotational_diffusion, at_least=0)
        check_number("alignment", alignment, at_least=0)
        self.force = as_real("force", force)
        self.rotational_diffusion = as_real("rotational_diffusion", rotational_diffusion)
        self.alignment = as_real("alignment", alignment)

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PropulsionState:
        """Uniformly distributed directions, and no previous motion."""
        check_planar("SelfPropulsion", tissue)
        angles = jax.random.uniform(key, (tissue.n_cells,), tissue.vertices.dtype, 0, 2 * jnp.pi)
        return PropulsionState(angles, jnp.zeros_like(tissue.vertices))

    def finish(self, state: PropulsionState, before: Tissue, tissue: Tissue) -> PropulsionState:
        """The state with the motion of the step."""
        return PropulsionState(state.angles, tissue.vertices - before.vertices)

    def drive(
        self,
        state: PropulsionState,
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PropulsionState]:
        """Forces on vertices; the next directions."""
        angles, m = state.angles, tissue.topology
        # Sum over the half-edges of each cell; `segment_sum` drops the exterior, which has index n_cells.
        velocity = jax.ops.segment_sum(state.displacement[m.source], m.cell, tissue.n_cells)
        at_rest = jnp.all(velocity == 0, axis=-1)
        heading = jnp.arctan2(velocity[:, 1], jnp.where(at_rest, 1, velocity[:, 0]))
        alignment = jnp.where(at_rest, 0, self.alignment * jnp.sin(heading - angles)) * dt
        noise = jax.random.normal(key, angles.shape, angles.dtype)
        angles = angles + alignment + safe_sqrt(2 * self.rotational_diffusion * dt) * noise
        direction = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
        remedy = "Give one number, or one for each cell."
        check_shape("force", self.force, (), angles.shape, remedy=remedy)
        force_per_vertex = jnp.broadcast_to(self.force, angles.shape)
        force_per_vertex = force_per_vertex / jnp.maximum(m.neighbour_counts, 1)
        at_corners = (
            (force_per_vertex[:, None] * direction).at[m.cell].get(mode="fill", fill_value=0)
        )
        force = jnp.sum(at_corners.reshape(-1, 3, 2), axis=1)
        return Push(force), PropulsionState(angles, state.displacement)
