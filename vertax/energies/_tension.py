"""Line tension of edges."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, check_number
from vertax._base.tracing import is_concrete
from vertax.energies._energy import AbstractLocalEnergy, OrFloat, as_parameter, per_edge
from vertax.mesh import Tissue


class LineTension(AbstractLocalEnergy):
    r"""$\sum_e \gamma_e\,\ell_e$, each edge counted once (Farhadifar et al. 2007).

    The sum with [`AreaElasticity`][vertax.energies.AreaElasticity] is the paper's energy
    $E_2 = \tfrac12 K \sum_c (A_c - A^0_c)^2 + \sum_e \gamma_e \ell_e$.

    **Arguments:**

    - `tension`: line tension $\gamma$, energy per length; scalar or one per edge.
    """

    tension: OrFloat[Float[Array, "*edges"]] = eqx.field(converter=partial(as_parameter, "tension"))

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return per_edge(self.tension, tissue, "tension") * tissue.edge_lengths


class BoundedTension(AbstractLocalEnergy):
    r"""Line tension between two fixed bounds: $\sum_e \gamma_e\,\ell_e$ with

    $$\gamma_e = \gamma_\mathrm{low} + (\gamma_\mathrm{high} - \gamma_\mathrm{low})\,
      \frac{1}{1 + e^{-z_e}}.$$

    A fit adjusts the logits $z$; the tension stays between the bounds for every value of $z$. Without
    bounds ([`LineTension`][vertax.energies.LineTension]) an optimiser may reach negative tensions, for
    which the energy has no minimum, or tensions for which cells collapse.

    **Arguments:**

    - `tension`: initial line tension $\gamma$, energy per length; scalar array or one per edge.
    - `low`, `high`: the bounds $\gamma_\mathrm{low}$ and $\gamma_\mathrm{high}$, constants.

    **Raises:**

    - `ValueError` if `low` is not below `high`, or if a tension is not between them.
    """

    logits: Float[Array, "*edges"]
    low: float
    high: float

    def __init__(self, tension: ArrayLike, low: float, high: float):
        check_number("low", low)
        check_number("high", high)
        if not low < high:
            raise ValueError(f"Argument `low` must be below `high`, but they are {low} and {high}.")
        tension = as_real("tension", tension).astype(jnp.result_type(float))
        if is_concrete(tension) and not jnp.all((tension > low) & (tension < high)):
            raise ValueError(
                f"Argument `tension` must be between {low} and {high}, but ranges from {tension.min()} "
                f"to {tension.max()}."
            )
        self.logits = jnp.log((tension - low) / (high - tension))
        self.low = float(low)
        self.high = float(high)

    @property
    def tension(self) -> Float[Array, "*edges"]:
        """Line tension of each edge, energy per length."""
        return self.low + (self.high - self.low) * jax.nn.sigmoid(self.logits)

    def edge_terms(self, tissue: Tissue) -> Float[Array, " edges"]:
        """Energy of each edge."""
        return per_edge(self.tension, tissue, "tension") * tissue.edge_lengths
