"""Thermal noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from vertax._base.checks import as_real, check_number
from vertax.activities._activity import AbstractActivity
from vertax.activities._push import Push
from vertax.dissipations import AbstractDissipation, AbstractViscosity
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class ThermalNoise(AbstractActivity):
    r"""Thermal noise by the fluctuation-dissipation theorem.

    For a dissipation $\tfrac1{2 \Delta t} \sum_i s_i^2$ the force is

    $$f = \sqrt{2 T / \Delta t}\, \sum_i \xi_i\, \partial s_i / \partial x$$

    with independent standard normal $\xi_i$; for friction $f = \sqrt{2 \zeta T / \Delta t}\, \xi$. In
    equilibrium each mode of a solid tissue has the mean energy $T / 2$; implicit Euler steps of length
    $\Delta t$ reduce it by the factor $1 + \lambda \Delta t / 2 \zeta$ for a mode of stiffness $\lambda$.

    **Arguments:**

    - `temperature`: $T$ in units of energy ($k_B T$).

    **Raises:**

    - `ValueError` for a negative temperature, and in a step for a dissipation that is not an
        [`AbstractViscosity`][vertax.dissipations.AbstractViscosity].
    """

    temperature: Float[Array, ""]

    def __init__(self, temperature: ArrayLike):
        check_number("temperature", temperature, at_least=0)
        self.temperature = as_real("temperature", temperature)

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation | None,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """A random force."""
        if not isinstance(dissipation, AbstractViscosity):
            raise ValueError(
                "The dissipation must be half a sum of squares (a subclass of "
                "vertax.dissipations.AbstractViscosity) for ThermalNoise, but is "
                f"{type(dissipation).__name__}. Derive it from AbstractViscosity."
            )
        strains_at = lambda vertices: dissipation.strains(tissue.with_vertices(vertices), tissue)
        strains, vjp = jax.vjp(strains_at, tissue.vertices)
        (force,) = vjp(jax.random.normal(key, strains.shape, strains.dtype))
        return Push(safe_sqrt(2 * self.temperature / dt) * force), state


def safe_sqrt(x: Float[Array, ""]) -> Float[Array, ""]:
    """The square root, with the derivative 0 at 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)
