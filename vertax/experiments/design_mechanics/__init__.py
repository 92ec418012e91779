"""Choose target shape factors of cells that give the tissue a mean shape factor."""

from vertax.experiments.design_mechanics.experiment import Config as Config, run as run
