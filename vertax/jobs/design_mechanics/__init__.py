"""Choose target shape factors of cells that give the tissue a mean shape factor."""

from .experiment import Config as Config, run as run
