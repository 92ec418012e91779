"""Energies: how a tissue wants to deform."""

from vertax.energies._elasticity import (
    AreaElasticity as AreaElasticity,
)
from vertax.energies._elasticity import (
    PerimeterElasticity as PerimeterElasticity,
)
from vertax.energies._elasticity import (
    ShapeFactorEnergy as ShapeFactorEnergy,
)
from vertax.energies._energy import (
    AbstractEnergy as AbstractEnergy,
)
from vertax.energies._energy import (
    AbstractLocalEnergy as AbstractLocalEnergy,
)
from vertax.energies._energy import (
    LocalSum as LocalSum,
)
from vertax.energies._energy import (
    Sum as Sum,
)
from vertax.energies._tension import LineTension as LineTension
