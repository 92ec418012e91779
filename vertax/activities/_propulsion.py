"""Cells that propel themselves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from vertax._base.checks import as_real, check_number
from vertax.activities._activity import AbstractActivity
from vertax.activities._noise import root
from vertax.activities._push import Push
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.energies._energy import per_cell
from vertax.mesh import Tissue


class SelfPropulsion(AbstractActivity):
    r"""Cells that push in a direction of their own, which diffuses: $\dot\theta = \sqrt{2 D_r}\, \eta(t)$.

    The force of a cell is shared out evenly among its vertices. The directions can align with the
    velocities of the cells, $\dot\theta = J \sin(\phi - \theta) + \dots$ with $\phi$ the direction in which a
    cell moved in the last step. (Bi et al. 2016, doi:10.1103/PhysRevX.6.021011, of Voronoi tissues.)

    **Arguments:**

    - `force`: of each cell; a scalar or one a cell.
    - `rotational_diffusion`: $D_r$, one over time.
    - `alignment`: $J$, one over time.

    **Raises:**

    - `ValueError` for negative numbers, or a force of another shape.
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

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """Random directions, and where the vertices are."""
        angles = jax.random.uniform(key, (tissue.n_cells,), tissue.vertices.dtype, 0, 2 * jnp.pi)
        return angles, tissue.vertices

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """Forces on vertices."""
        angles, last = state
        m = tissue.topology
        # Cells of half-edges; the exterior, of number n_cells, is dropped.
        moved = (tissue.vertices - last)[m.source]
        velocity = jax.ops.segment_sum(moved, m.cell, tissue.n_cells)
        still = jnp.all(velocity == 0, axis=-1)
        ahead = jnp.arctan2(velocity[:, 1], jnp.where(still, 1, velocity[:, 0]))
        turn = jnp.where(still, 0, self.alignment * jnp.sin(ahead - angles)) * dt
        noise = jax.random.normal(key, angles.shape, angles.dtype)
        angles = angles + turn + root(2 * self.rotational_diffusion * dt) * noise
        direction = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
        shares = jnp.broadcast_to(
            per_cell(self.force, tissue, "force"), angles.shape
        ) / jnp.maximum(m.neighbour_counts, 1)
        at_corners = (shares[:, None] * direction).at[m.cell].get(mode="fill", fill_value=0)
        force = jnp.sum(at_corners.reshape(-1, 3, 2), axis=1)
        return Push(force), (angles, tissue.vertices)
