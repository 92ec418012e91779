"""The settings of a relaxation, until they move to `_relaxation`."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, Float

from vertax.adjoints import AbstractAdjoint
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.responses._relaxation import Equilibrium, equilibrate
from vertax.transitions import T1, AbstractTransitions


class Relaxation(eqx.Module):
    """How a tissue comes to rest."""

    solver: optx.AbstractMinimiser[Any, Any, Any] | None = None
    transitions: AbstractTransitions | None = T1()
    tolerance: float | Float[Array, ""] | None = None
    patience: int = 1
    max_steps: int = 2000

    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
    ) -> Equilibrium:
        """Relax."""
        return equilibrate(tissue, energy, adjoint=adjoint, throw=throw, **vars(self))
