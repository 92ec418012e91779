"""Versions of installed packages."""

from __future__ import annotations

import importlib.metadata


def installed_version(name: str) -> str:
    """Version of an installed package.

    **Arguments:**

    - `name`: the name of the package.

    **Returns:** its version, or `"(not installed)"` for one that runs from its source folder.
    """
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"
