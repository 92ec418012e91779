"""Functions that several experiments use."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def columns(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The table of some rows: an array per column, in the order of the first row."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
