"""Diffusion of cells that propel themselves, against target shape factor and force."""

from .experiment import Config as Config, run as run
