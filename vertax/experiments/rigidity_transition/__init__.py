"""Where tissues turn from solid to fluid as the target shape factor grows."""

from vertax.experiments.rigidity_transition.experiment import Config as Config, run as run
