"""Errors of the user, which the command line prints without a traceback."""

from __future__ import annotations


class ConfigError(ValueError):
    """A configuration that cannot be used; the message has the key and the allowed values."""


class RunFolderError(ValueError):
    """A folder that a run must not overwrite, or without a run."""


class UnfinishedRunError(RunFolderError):
    """The folder of a run that is not finished."""
