"""Figures as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vertax._base.extras import requires_extra
from vertax.io import atomic_write
from vertax.runs._errors import RunFolderError

with requires_extra("run", "The folder of a run"):
    import matplotlib
    from matplotlib.figure import Figure

FIGURE_FORMATS = ("png", "pdf", "svg")
# Reproducible files, and text in a PDF as text.
_UNDATED: dict[str, dict[str, None]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
_VECTOR_STYLE: Any = {"pdf.fonttype": 42, "svg.hashsalt": "vertax"}


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format that the ending of `path` names, atomically."""
    ending = path.suffix[1:]
    with matplotlib.rc_context(_VECTOR_STYLE), atomic_write(path, "wb") as file:
        figure.savefig(file, format=ending, dpi=200, metadata=_UNDATED.get(ending))


def checked_formats(formats: Sequence[str]) -> tuple[str, ...]:
    """The formats, each once.

    **Raises:**

    - `RunFolderError` for one that is none, or if there are none at all.
    """
    wrong = [ending for ending in formats if ending not in FIGURE_FORMATS]
    if wrong or not formats or isinstance(formats, str):
        raise RunFolderError(
            f"Figures are written as {', '.join(FIGURE_FORMATS)} (one or more of them), but "
            f"{', '.join(map(repr, wrong)) or repr(formats)} was asked for."
        )
    return tuple(dict.fromkeys(formats))
