"""Mechanical energies of a tissue."""

from vertax.energies._ablation import Ablated as Ablated
from vertax.energies._by_type import TypeTension as TypeTension, by_type as by_type
from vertax.energies._elasticity import (
    AreaElasticity as AreaElasticity,
    PerimeterElasticity as PerimeterElasticity,
    ShapeFactorEnergy as ShapeFactorEnergy,
)
from vertax.energies._energy import (
    AbstractEnergy as AbstractEnergy,
    AbstractLocalEnergy as AbstractLocalEnergy,
    LocalSum as LocalSum,
    Sum as Sum,
)
from vertax.energies._foam import foam_energy as foam_energy
from vertax.energies._tension import BoundedTension as BoundedTension, LineTension as LineTension
