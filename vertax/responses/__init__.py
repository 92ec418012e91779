"""Responses: how a tissue answers to its energy."""

from vertax.responses._evolution import Evolution as Evolution, evolve as evolve
from vertax.responses._evolved import Evolved as Evolved
from vertax.responses._evolver import SurfaceEvolver as SurfaceEvolver
from vertax.responses._external import External as External
from vertax.responses._material import Material as Material
from vertax.responses._program import run_program as run_program
from vertax.responses._recording import record_relaxation as record_relaxation
from vertax.responses._relaxation import Relaxation as Relaxation, equilibrate as equilibrate
from vertax.responses._response import (
    AbstractResponse as AbstractResponse,
    Equilibrium as Equilibrium,
)
from vertax.responses._simulator import (
    AbstractSimulator as AbstractSimulator,
    Edges as Edges,
    Ledger as Ledger,
    Relaxed as Relaxed,
    SimulatorError as SimulatorError,
)
from vertax.responses._step_control import StepControl as StepControl
from vertax.responses._trajectory import Trajectory as Trajectory
