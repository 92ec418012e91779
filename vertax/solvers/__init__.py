"""Solvers: minimisers that relax a tissue, and the linear solver behind implicit gradients."""

from vertax._base.scales import Scales as Scales
from vertax.solvers._conjugate_gradients import TruncatedCG as TruncatedCG
from vertax.solvers._direct import Direct as Direct
from vertax.solvers._first_order import (
    FIRE as FIRE,
    LBFGS as LBFGS,
    GradientDescent as GradientDescent,
    Optax as Optax,
)
from vertax.solvers._minres import MINRES as MINRES
from vertax.solvers._newton import NewtonCG as NewtonCG
from vertax.solvers._optimistix import Wrapped as Wrapped
from vertax.solvers._solver import (
    AbstractIteration as AbstractIteration,
    AbstractSolver as AbstractSolver,
    Progress as Progress,
)
from vertax.solvers._trust_region import VertexTrustRegion as VertexTrustRegion
