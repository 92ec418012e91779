"""Fluctuating line tensions."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from vertax._base.checks import as_real, check_number
from vertax.activities._activity import AbstractActivity
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy, LineTension
from vertax.mesh import Tissue


class TensionState(eqx.Module):
    """The state of [`FluctuatingTensions`][vertax.activities.FluctuatingTensions]."""

    relative: Float[Array, " edges"]
    """The tension of each edge, in units of the standard deviation."""


class FluctuatingTensions(AbstractActivity):
    r"""Active line tensions of mean 0, an independent Ornstein–Uhlenbeck process for each edge.

    $$\langle \gamma_e(t)\, \gamma_e(t') \rangle = \sigma^2 e^{-|t - t'| / \tau}$$

    Steps of any length draw from the exact transition distribution. (As in Krajnc 2020, Soft Matter 16, 3209,
    and Yamamoto et al. 2022.)

    **Arguments:**

    - `deviation`: standard deviation $\sigma$, energy per length.
    - `persistence`: correlation time $\tau$.

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

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> TensionState:
        """Stationary tensions."""
        return TensionState(jax.random.normal(key, (tissue.n_edges,), tissue.vertices.dtype))

    def drive(
        self,
        state: TensionState,
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, TensionState]:
        """Line tensions, and the next state."""
        decay = jnp.exp(-dt / self.persistence)
        noise = jax.random.normal(key, state.relative.shape, state.relative.dtype)
        # 1 - exp(-2 dt / τ); `expm1` avoids the cancellation for dt much smaller than τ.
        variance = -jnp.expm1(-2 * dt / self.persistence)
        relative = decay * state.relative + jnp.sqrt(variance) * noise
        return LineTension(self.deviation * relative), TensionState(relative)
