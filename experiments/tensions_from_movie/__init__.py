"""Infer the tensions of a cluster that is not at rest, from several frames of a movie."""

from .experiment import Config as Config, run as run
