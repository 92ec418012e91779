"""Solvers: minimisers that relax a tissue, and the linear solver behind implicit gradients."""

from vertax.solvers._first_order import (
    FIRE as FIRE,
)
from vertax.solvers._first_order import (
    LBFGS as LBFGS,
)
from vertax.solvers._first_order import (
    GradientDescent as GradientDescent,
)
from vertax.solvers._first_order import (
    Optax as Optax,
)
from vertax.solvers._minres import MINRES as MINRES
from vertax.solvers._newton import NewtonCG as NewtonCG
from vertax.solvers._optimistix import Wrapped as Wrapped
from vertax.solvers._solver import AbstractSolver as AbstractSolver
