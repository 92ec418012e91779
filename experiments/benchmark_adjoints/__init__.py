"""Compare automatic and implicit differentiation and equilibrium propagation."""

from .experiment import run as run
from .problems import Config as Config
