"""Shear and bulk modulus of disordered tissues as the target shape factor grows."""

from .experiment import Config as Config, run as run
