"""Responses: how a tissue answers to its energy."""

from vertax.responses._relaxation import Equilibrium as Equilibrium, equilibrate as equilibrate
from vertax.responses._settings import Relaxation as Relaxation
