"""External programs as forward models."""

from vertax.external._evolver import SurfaceEvolver as SurfaceEvolver
from vertax.external._external import External as External
from vertax.external._program import run_program as run_program
from vertax.external._simulator import (
    AbstractSimulator as AbstractSimulator,
    Edges as Edges,
    Ledger as Ledger,
    Relaxed as Relaxed,
    SimulatorError as SimulatorError,
)
