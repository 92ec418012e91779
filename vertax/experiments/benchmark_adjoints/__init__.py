"""Compare automatic and implicit differentiation and equilibrium propagation."""

from vertax.experiments.benchmark_adjoints.experiment import Config as Config, run as run
