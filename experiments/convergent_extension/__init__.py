"""Choose tensions of edges that elongate a cluster of cells."""

from .experiment import Config as Config, run as run
