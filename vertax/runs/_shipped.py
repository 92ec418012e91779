"""The configurations that come with vertax, by name."""

from __future__ import annotations

import difflib
import os
import tomllib
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]
REPOSITORY = _PACKAGE.parent if (_PACKAGE.parent / "pyproject.toml").is_file() else None
"""The repository that this package is part of; None for an installed wheel."""


def shipped_configurations() -> dict[str, Path]:
    """The configurations that come with vertax.

    **Returns:** their files by name, sorted: from the wheel, or from the folder `configs` of the repository.
    """
    folders = (_PACKAGE / "configs", _PACKAGE.parent / "configs")
    folder = next((each for each in folders if each.is_dir()), None)
    return {} if folder is None else {file.stem: file for file in sorted(folder.glob("*.toml"))}


def configuration_file(name: str | os.PathLike[str]) -> Path:
    """The file of a configuration.

    **Arguments:**

    - `name`: a file, or the name of a configuration that comes with vertax. A file of that name comes first.

    **Returns:** the path. If there is neither, `name` itself.
    """
    path = Path(name)
    return path if path.is_file() else shipped_configurations().get(os.fspath(name), path)


def nearest_configuration(name: str | os.PathLike[str]) -> str:
    """A hint for a configuration that does not exist.

    **Arguments:**

    - `name`: its name.

    **Returns:** a sentence that begins with a space, or an empty text if no configurations are installed.
    """
    names = shipped_configurations()
    if not names:
        return ""
    near = difflib.get_close_matches(Path(name).stem, names, n=1, cutoff=0.6)
    if near:
        return f" Did you mean {near[0]}, which comes with vertax?"
    return " `vertax list` shows those that come with vertax."


def configuration_of(file: Path) -> Any:
    """The experiment that a shipped configuration names.

    **Arguments:**

    - `file`: the configuration.

    **Returns:** the value of its key `experiment`; None if there is none.
    """
    return tomllib.loads(file.read_text(encoding="utf-8")).get("experiment")


def configuration_summary(file: Path) -> str:
    """The first sentence of the comment at the start of a configuration."""
    words: list[str] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        words += line.lstrip("#").split()
        ends = [k for k, word in enumerate(words) if word.endswith((".", ":"))]
        if ends:
            return " ".join(words[: ends[0] + 1]).rstrip(".:")
    return " ".join(words)
