"""Choose tensions of edges that keep cells of one type apart."""

from vertax.experiments.salt_and_pepper.experiment import Config as Config, run as run
