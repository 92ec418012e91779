"""Print the path of the newest Python of this machine, if it is newer than the one that runs this script.

`make test-newest` uses it. It needs only the standard library.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator

VERSIONS = ("3.14", "3.13", "3.12")
TIMEOUT = 30.0
"""Seconds after which a program is stopped and skipped."""


def newest_python() -> str | None:
    """The path of the newest working Python that is newer than this one; None if there is none."""
    for version in VERSIONS:
        if tuple(map(int, version.split("."))) <= sys.version_info[:2]:
            return None
        for path in _candidates(f"python{version}"):
            executable = _executable(path, version)
            if executable is not None:
                return executable
    return None


def _candidates(name: str) -> Iterator[str]:
    """Paths of programs with this name in the folders of PATH and in pyenv."""
    for folder in os.get_exec_path():
        path = shutil.which(name, path=folder)
        if path is not None:
            yield path
    # pyenv adds a shim for each version to PATH, which fails unless that version is activated.
    if shutil.which("pyenv") is not None:
        for version in reversed(_output(["pyenv", "whence", name]).split()):
            yield _output(["pyenv", "which", name], PYENV_VERSION=version)


def _executable(path: str, version: str) -> str | None:
    """The path of the interpreter that `path` starts; None if it cannot make a virtual environment."""
    # (Debian installs `ensurepip` separately.)
    script = (
        "import ensurepip, sys, venv; print(*sys.version_info[:2], sep='.'); print(sys.executable)"
    )
    lines = _output([path, "-c", script]).splitlines() if path else []
    return lines[1] if lines[:1] == [version] else None


def _output(command: list[str], **environment: str) -> str:
    """The standard output of a program; empty if it fails."""
    try:
        process = subprocess.run(
            command,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return process.stdout.strip()


if __name__ == "__main__":
    print(newest_python() or "")
