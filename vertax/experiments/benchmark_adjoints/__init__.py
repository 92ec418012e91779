"""Compare automatic and implicit differentiation and equilibrium propagation."""

from .experiment import Config as Config, run as run
