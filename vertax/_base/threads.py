"""The number of threads of computations side by side."""

from __future__ import annotations

import os

THREADS = "VERTAX_THREADS"  # the environment variable with the number of threads


def num_threads() -> int:
    """The number of threads: the environment variable, or one per core."""
    number = os.environ.get(THREADS, "")
    return max(int(number), 1) if number.isdecimal() else os.cpu_count() or 1
