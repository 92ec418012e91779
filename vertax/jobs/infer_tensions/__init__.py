"""Infer relative tensions and pressures of a cluster from its segmented image."""

from .experiment import Config as Config, run as run
