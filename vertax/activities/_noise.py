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
    r"""Noise that belongs to the dissipation at a temperature, by fluctuation and dissipation.

    With a dissipation $\tfrac1{2 \Delta t} \sum_i s_i^2$ each square has a noise of its own, independent
    normal numbers $\xi_i$: the force is $\sqrt{2 T / \Delta t}\, \sum_i \xi_i\, \partial s_i / \partial x$,
    for friction $\sqrt{2 \zeta T / \Delta t}\, \xi$. In equilibrium each mode of a solid tissue has the mean
    energy $T / 2$ (and in steps of length $\Delta t$ less by a factor $1 + \lambda \Delta t / 2 \zeta$).

    **Arguments:**

    - `temperature`: $T$ in units of energy, $k_B$ included.

    **Raises:**

    - `ValueError` for a negative temperature, and in a step for a dissipation that is no sum of squares.
    """

    temperature: Float[Array, ""]

    def __init__(self, temperature: ArrayLike):
        check_number("temperature", temperature, at_least=0)
        self.temperature = as_real("temperature", temperature)

    def drive(
        self,
        state: PyTree[Array],
        tissue: Tissue,
        dissipation: AbstractDissipation,
        time: Float[Array, ""],
        dt: Float[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[AbstractEnergy, PyTree[Array]]:
        """A random force."""
        if not isinstance(dissipation, AbstractViscosity):
            raise ValueError(
                "ThermalNoise needs to know what is squared in the dissipation, and "
                f"{type(dissipation).__name__} does not say: make it a subclass of "
                "vertax.dissipations.AbstractViscosity."
            )
        moved = lambda vertices: dissipation.strains(tissue.with_vertices(vertices), tissue)
        strains, pull = jax.vjp(moved, tissue.vertices)
        (force,) = pull(jax.random.normal(key, strains.shape, strains.dtype))
        return Push(root(2 * self.temperature / dt) * force), state


def root(x: Float[Array, ""]) -> Float[Array, ""]:
    """The square root, with the slope 0 at 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)
