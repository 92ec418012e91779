"""Find the tensions of a foam with Surface Evolver as the only forward model."""

from .experiment import Config as Config, run as run
