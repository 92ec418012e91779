"""The solid part of a stress-strain curve, used by `stiffening` and by `figures`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Branch(NamedTuple):
    """One tissue sheared one way, from its onset on."""

    strains: Float[np.ndarray, " points"]
    stresses: Float[np.ndarray, " points"]
    moduli: Float[np.ndarray, " points"]
    onset: float
    """The strain at which it becomes solid."""

    def line(self, centre: float) -> tuple[float, float]:
        """Slope and offset of the modulus over the stress per strain, counted from a centre."""
        slope, offset = np.polyfit(self.stresses / (self.strains - centre), self.moduli, 1)
        return float(slope), float(offset)
