"""Adjoints: how to differentiate through an equilibrium."""

from vertax.adjoints._adjoint import AbstractAdjoint as AbstractAdjoint
from vertax.adjoints._implicit import ImplicitDifferentiation as ImplicitDifferentiation
