from . import (
    activities as activities,
    adjoints as adjoints,
    bayes as bayes,
    costs as costs,
    dissipations as dissipations,
    dynamics as dynamics,
    energies as energies,
    external as external,
    fitting as fitting,
    growth as growth,
    inference as inference,
    initialise as initialise,
    io as io,
    mechanics as mechanics,
    mesh as mesh,
    plotting as plotting,
    relax as relax,
    runs as runs,
    signals as signals,
    solvers as solvers,
    surfaces as surfaces,
    tensions as tensions,
    transitions as transitions,
)
from ._base.compilation_cache import enable_compilation_cache as enable_compilation_cache
from ._base.results import RESULTS as RESULTS
from ._base.tasks import map_tasks as map_tasks
from .activities import AbstractActivity as AbstractActivity
from .adjoints import (
    AutomaticDifferentiation as AutomaticDifferentiation,
    EquilibriumPropagation as EquilibriumPropagation,
    GradientOutcome as GradientOutcome,
    ImplicitDifferentiation as ImplicitDifferentiation,
)
from .costs import AbstractCost as AbstractCost
from .dissipations import AbstractDissipation as AbstractDissipation
from .dynamics import Evolution as Evolution, evolve as evolve
from .energies import (
    AbstractEnergy as AbstractEnergy,
    AbstractLocalEnergy as AbstractLocalEnergy,
)
from .external import External as External
from .fitting import (
    Checkpoint as Checkpoint,
    Evaluation as Evaluation,
    Fit as Fit,
    FitError as FitError,
    History as History,
    InverseProblem as InverseProblem,
    Record as Record,
    Uncertainty as Uncertainty,
    fit as fit,
    uncertainty as uncertainty,
)
from .io import load as load, save as save
from .mesh import (
    AbstractBoundary as AbstractBoundary,
    Free as Free,
    Periodic as Periodic,
    Tissue as Tissue,
    Topology as Topology,
)
from .plotting import (
    animate as animate,
    plot_history as plot_history,
    plot_recovery as plot_recovery,
    plot_tissue as plot_tissue,
)
from .relax import (
    AbstractResponse as AbstractResponse,
    Equilibrium as Equilibrium,
    Relaxation as Relaxation,
    equilibrate as equilibrate,
)
from .solvers import MINRES as MINRES
from .transitions import T1 as T1, T2 as T2, AbstractTransitions as AbstractTransitions

__version__: str
