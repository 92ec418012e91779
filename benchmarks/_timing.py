"""Timing of compiled functions."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


def first_and_best(
    function: Callable[..., Any], *args: Any, repeats: int = 7
) -> tuple[float, float]:
    """Seconds of the first call (which compiles) and of the fastest of `repeats` later ones."""

    def once() -> float:
        began = time.perf_counter()
        jax.block_until_ready(eqx.filter(function(*args), eqx.is_array))
        return time.perf_counter() - began

    first = once()
    return first, min(once() for _ in range(repeats))
