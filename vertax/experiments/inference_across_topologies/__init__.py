"""Recover shape factors where the fit has to lead through T1 transitions."""

from vertax.experiments.inference_across_topologies.experiment import Config as Config, run as run
