"""Infer the target shape factors of the cells in a microscopy image."""

from vertax.experiments.infer_from_microscopy.experiment import Config as Config, run as run
