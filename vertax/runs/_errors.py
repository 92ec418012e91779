"""What a user can cause and mend: the command line shows the message and no traceback."""

from __future__ import annotations


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says where and what would be right."""


class RunFolderError(ValueError):
    """A folder that a run must not write to, or that holds none."""


class UnfinishedRunError(RunFolderError):
    """The folder of a run that did not come to its end."""
