"""Recover hidden target shape factors of a synthetic tissue from its vertices or an image."""

from .experiment import Config as Config, run as run
