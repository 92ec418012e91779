"""Dissipations: friction and viscosity of a tissue."""

from vertax.dissipations._dissipation import (
    AbstractDissipation as AbstractDissipation,
    AbstractViscosity as AbstractViscosity,
    Sum as Sum,
    ViscositySum as ViscositySum,
)
from vertax.dissipations._friction import SubstrateFriction as SubstrateFriction
from vertax.dissipations._viscosity import (
    AreaViscosity as AreaViscosity,
    EdgeViscosity as EdgeViscosity,
    PerimeterViscosity as PerimeterViscosity,
)
