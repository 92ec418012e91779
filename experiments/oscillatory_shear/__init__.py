"""Storage and loss modulus of tissues that are sheared to and fro, against frequency."""

from .experiment import Config as Config, run as run
