"""Typical sizes of a problem."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Scales(eqx.Module):
    r"""Typical sizes of a tissue and its energy, in which solvers and adjoints express their constants.

    With them a relaxation is independent of the user's units. They are the option `scales` of a minimisation.
    """

    length: Float[Array, ""] = eqx.field(default=1.0, converter=jnp.asarray)
    """Square root of the mean cell area."""
    stiffness: Float[Array, ""] = eqx.field(default=1.0, converter=jnp.asarray)
    """A typical second derivative of the energy; 1 if that is 0 or not finite."""
    tolerance: Float[Array, ""] = eqx.field(default=math.inf, converter=jnp.asarray)
    """The largest force at rest; infinite if there is none."""

    @property
    def force(self) -> Float[Array, ""]:
        """Stiffness times length."""
        return self.stiffness * self.length

    @classmethod
    def of(cls, options: dict[str, Any]) -> Scales:
        """The scales in the options of a minimisation; 1 if there are none."""
        return options["scales"] if "scales" in options else cls()
