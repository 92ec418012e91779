"""Tell a stiff from a fluid-like epithelium by its microscopy images."""

from vertax.experiments.compare_conditions.experiment import Config as Config, run as run
