"""A differentiable vertex model of epithelial tissue, on JAX and Equinox."""

from vertax import (
    adjoints as adjoints,
)
from vertax import (
    costs as costs,
)
from vertax import (
    energies as energies,
)
from vertax import (
    initialise as initialise,
)
from vertax import (
    io as io,
)
from vertax import (
    plotting as plotting,
)
from vertax import (
    solvers as solvers,
)
from vertax._bilevel import (
    Fit as Fit,
)
from vertax._bilevel import (
    FitError as FitError,
)
from vertax._bilevel import (
    History as History,
)
from vertax._bilevel import (
    InverseProblem as InverseProblem,
)
from vertax._bilevel import (
    fit as fit,
)
from vertax._boundary import AbstractBoundary as AbstractBoundary
from vertax._boundary import Periodic as Periodic
from vertax._equilibrium import Equilibrium as Equilibrium
from vertax._equilibrium import equilibrate as equilibrate
from vertax._tissue import Tissue as Tissue
from vertax._topology import Topology as Topology
from vertax._transitions import T1 as T1
from vertax._transitions import AbstractTransitions as AbstractTransitions
from vertax.adjoints import ImplicitDifferentiation as ImplicitDifferentiation
from vertax.costs import AbstractCost as AbstractCost
from vertax.energies import (
    AbstractEnergy as AbstractEnergy,
)
from vertax.energies import (
    AbstractLocalEnergy as AbstractLocalEnergy,
)
from vertax.io import load_tissue as load_tissue
from vertax.io import save_tissue as save_tissue
from vertax.plotting import (
    plot_history as plot_history,
)
from vertax.plotting import (
    plot_recovery as plot_recovery,
)
from vertax.plotting import (
    plot_tissue as plot_tissue,
)
from vertax.solvers import MINRES as MINRES
