"""Infer the target shape factors of the cells in a microscopy image."""

from .experiment import Config as Config, run as run
