"""Tensions in time that elongate a cluster along a prescribed course."""

from .experiment import Config as Config, run as run
