"""A tissue that grows from a few cells to hundreds, and how many neighbours its cells have."""

from .experiment import Config as Config, run as run
