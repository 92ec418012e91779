"""What a tissue is made of: its energy, what resists and what drives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from vertax._base.checks import describe
from vertax.activities import AbstractActivity
from vertax.dissipations import AbstractDissipation
from vertax.energies import AbstractEnergy
from vertax.energies._energy import check_energy
from vertax.mesh import Tissue


class Material(AbstractEnergy):
    """An energy together with what resists the motion and what drives it, to be fitted as one.

    ```python
    material = vx.dynamics.Material(energy, vx.dissipations.SubstrateFriction(1.0))
    problem = vx.InverseProblem(first, material, cost, response=vx.Evolution(friction, times))
    vx.fit(problem, optimiser, 20).energy.dissipation.coefficient
    ```

    Positions and times tell energies over frictions, so one of them must be known: `trainable` says which.

    **Arguments:**

    - `energy`: an energy, or a function of time that returns one.
    - `dissipation`: in place of that of the [`Evolution`][vertax.Evolution]; None leaves that.
    - `activity`: in place of that of the evolution; None leaves that.

    **Raises:**

    - `TypeError` for what is none of these.
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
            if value is not None and not isinstance(value, kind):
                raise TypeError(
                    f"Argument `{name}` of Material must be an {kind.__name__} or None, but is "
                    f"{describe(value)}."
                )

    def __call__(self, tissue: Tissue) -> Float[Array, ""]:
        """The energy of a tissue, if that is no function of time."""
        if isinstance(self.energy, AbstractEnergy):
            return self.energy(tissue)
        raise TypeError(
            "The energy of this Material is a function of time: use it in an Evolution."
        )
