"""Infer relative tensions and pressures of a cluster from its segmented image."""

from vertax.experiments.infer_tensions.experiment import Config as Config, run as run
