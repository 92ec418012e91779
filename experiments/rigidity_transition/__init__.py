"""Where tissues turn from solid to fluid as the target shape factor grows."""

from .experiment import Config as Config, run as run
