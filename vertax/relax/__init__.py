"""Relaxation: the mechanical equilibrium of a tissue."""

from vertax.relax._recording import record_relaxation as record_relaxation
from vertax.relax._relaxation import Relaxation as Relaxation, equilibrate as equilibrate
from vertax.relax._response import (
    AbstractResponse as AbstractResponse,
    Equilibrium as Equilibrium,
)
