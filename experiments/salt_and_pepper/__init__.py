"""Choose tensions of edges that keep cells of one type apart."""

from .experiment import Config as Config, run as run
