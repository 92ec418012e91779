"""Adjoints: methods to differentiate through an equilibrium."""

from vertax.adjoints._adjoint import (
    AbstractAdjoint as AbstractAdjoint,
    GradientOutcome as GradientOutcome,
)
from vertax.adjoints._automatic import AutomaticDifferentiation as AutomaticDifferentiation
from vertax.adjoints._implicit import ImplicitDifferentiation as ImplicitDifferentiation
from vertax.adjoints._propagation import EquilibriumPropagation as EquilibriumPropagation
