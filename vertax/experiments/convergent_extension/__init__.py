"""Choose tensions of edges that elongate a cluster of cells."""

from vertax.experiments.convergent_extension.experiment import Config as Config, run as run
