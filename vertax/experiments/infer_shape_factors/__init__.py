"""Recover hidden target shape factors of a synthetic tissue from its vertices or an image."""

from vertax.experiments.infer_shape_factors.experiment import Config as Config, run as run
