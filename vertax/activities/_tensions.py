"""Tensions that fluctuate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from vertax._base.checks import as_real, check_number
from vertax.activities._activity import AbstractActivity
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy, LineTension
from vertax.mesh import Tissue


class FluctuatingTensions(AbstractActivity):
    r"""Active tensions of edges around 0, each an Ornstein–Uhlenbeck process.

    Tensions have a standard deviation $\sigma$ and forget themselves in a time $\tau$; steps of any length
    draw from the exact distribution. (As in Krajnc 2020, Soft Matter 16, 3209, and Yamamoto et al. 2022.)

    **Arguments:**

    - `deviation`: $\sigma$, energy per length.
    - `persistence`: $\tau$, a time.

    **Raises:**

    - `ValueError` for a negative deviation, or a persistence that is not positive.
    """

    deviation: Float[Array, ""]
    persistence: Float[Array, ""]

    def __init__(self, deviation: ArrayLike, persistence: ArrayLike):
        check_number("deviation", deviation, at_least=0)
        check_number("persistence", persistence, above=0)
        self.deviation = as_real("deviation", deviation)
        self.persistence = as_real("persistence", persistence)

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """Tensions in units of their deviation."""
        return jax.random.normal(key, (tissue.n_edges,), tissue.vertices.dtype)

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """Tensions of edges."""
        left = jnp.exp(-dt / self.persistence)
        drawn = jax.random.normal(key, state.shape, state.dtype)
        # 1 - exp(-2 dt / τ), which would lose all digits for dt / τ near the unit of rounding.
        forgotten = -jnp.expm1(-2 * dt / self.persistence)
        state = left * state + jnp.sqrt(forgotten) * drawn
        return LineTension(self.deviation * state), state
