"""A differentiable vertex model of epithelial tissue, on JAX and Equinox."""

from vertax import (
    adjoints as adjoints,
    costs as costs,
    energies as energies,
    initialise as initialise,
    io as io,
    plotting as plotting,
    solvers as solvers,
)
from vertax._boundary import (
    AbstractBoundary as AbstractBoundary,
    Free as Free,
    Periodic as Periodic,
)
from vertax._checkpoint import Checkpoint as Checkpoint
from vertax._equilibrium import Equilibrium as Equilibrium, equilibrate as equilibrate
from vertax._fit import fit as fit
from vertax._history import (
    Fit as Fit,
    FitError as FitError,
    History as History,
    Record as Record,
)
from vertax._inverse import InverseProblem as InverseProblem
from vertax._tissue import Tissue as Tissue
from vertax._topology import Topology as Topology
from vertax._transitions import T1 as T1, AbstractTransitions as AbstractTransitions
from vertax._uncertainty import Uncertainty as Uncertainty, uncertainty as uncertainty
from vertax.adjoints import (
    AutomaticDifferentiation as AutomaticDifferentiation,
    EquilibriumPropagation as EquilibriumPropagation,
    GradientOutcome as GradientOutcome,
    ImplicitDifferentiation as ImplicitDifferentiation,
)
from vertax.costs import AbstractCost as AbstractCost
from vertax.energies import (
    AbstractEnergy as AbstractEnergy,
    AbstractLocalEnergy as AbstractLocalEnergy,
)
from vertax.io import load_tissue as load_tissue, save_tissue as save_tissue
from vertax.plotting import (
    animate as animate,
    plot_history as plot_history,
    plot_recovery as plot_recovery,
    plot_tissue as plot_tissue,
)
from vertax.solvers import MINRES as MINRES
