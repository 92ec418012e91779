"""Recover shape factors where the fit has to lead through T1 transitions."""

from .experiment import Config as Config, run as run
