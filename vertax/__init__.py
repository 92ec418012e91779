"""A differentiable vertex model of epithelial tissue, on JAX and Equinox."""

from vertax import energies as energies, initialise as initialise, solvers as solvers
from vertax._boundary import AbstractBoundary as AbstractBoundary, Periodic as Periodic
from vertax._equilibrium import Equilibrium as Equilibrium, equilibrate as equilibrate
from vertax._tissue import Tissue as Tissue
from vertax._topology import Topology as Topology
from vertax._transitions import T1 as T1, AbstractTransitions as AbstractTransitions
from vertax.adjoints import ImplicitDifferentiation as ImplicitDifferentiation
from vertax.energies import (
    AbstractEnergy as AbstractEnergy,
    AbstractLocalEnergy as AbstractLocalEnergy,
)
