"""A material: an energy, a dissipation and an activity, as one object to fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from vertax._base.checks import check_instance
from vertax._base.model_checks import check_energy
from vertax.activities import AbstractActivity
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Material(AbstractEnergy):
    """An energy with a dissipation and an activity, to be fitted together.

    ```python
    material = vx.dynamics.Material(energy, vx.dissipations.SubstrateFriction(1.0))
    problem = vx.InverseProblem(first, material, cost, response=vx.Evolution(friction, times))
    vx.fit(problem, optimiser, 20).energy.dissipation.coefficient
    ```

    Positions and times determine only the ratio of energy to dissipation, so the scale of one of them must be
    fixed: select the others with `trainable`.

    **Arguments:**

    - `energy`: an energy, or a function of time that returns one.
    - `dissipation`: replaces the dissipation of the [`Evolution`][vertax.Evolution], unless None.
    - `activity`: replaces the activity of the evolution, unless None.

    **Raises:**

    - `TypeError` for an argument of the wrong class.
    """

    energy: AbstractEnergy | Callable[[Float[Array, ""]], AbstractEnergy]
    dissipation: AbstractDissipation | None = None
    activity: AbstractActivity | None = None

    def __check_init__(self):
        check_energy(self.energy)
        for name, kind in (
            ("dissipation", AbstractDissipation),
            ("activity", AbstractActivity),
        ):
            value: Any = getattr(self, name)
            check_instance(name, value, kind | None, f"an {kind.__name__} or None")

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of a tissue; a `TypeError` if the energy is a function of time."""
        if isinstance(self.energy, AbstractEnergy):
            return self.energy(tissue)
        raise TypeError(
            "The energy of this Material is a function of time: use it in an Evolution."
        )
