"""A warning before compiled functions use up the memory maps of the process (Linux)."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import jax.numpy as jnp

from vertax._base.tracing import is_concrete

MAPS = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
FRACTION = 0.7
"""Fraction of the limit at which to warn; one compilation may need thousands of memory maps."""
INTERVAL = 1.0
"""Least time between two counts in seconds; a count takes milliseconds."""

_last_count = 0.0
_has_warned = False


def memory_maps() -> int:
    """Number of memory maps of this process; 0 on systems other than Linux."""
    return MAPS.read_bytes().count(b"\n") if MAPS.exists() else 0


def warn_of_memory_maps() -> None:
    """Warn once per process if compiled functions use most of the memory maps that the system allows.

    Each function that XLA compiles for a CPU uses several memory maps; the gradient for one tissue size uses
    more than a thousand. Linux allows 65530; above, LLVM cannot allocate memory and the process ends with a
    segmentation fault. Call this before a compilation; inside a trace it does nothing.
    """
    global _last_count, _has_warned
    now = time.monotonic()
    # (Inside a trace a new array is a tracer.)
    if _has_warned or now - _last_count < INTERVAL or not is_concrete(jnp.zeros(())):
        return
    _last_count = now
    try:
        limit = int(LIMIT.read_text())
    except (OSError, ValueError):
        return  # not Linux
    count = memory_maps()
    if count < FRACTION * limit or not count:
        return
    _has_warned = True
    warnings.warn(
        f"This process holds {count} of the {limit} memory maps that the system allows, most of them for "
        "compiled functions; at the limit it ends by a segmentation fault. Pad tissues to a few sizes "
        "(vertax.mesh.pad), call jax.clear_caches() and equinox.clear_caches() between sizes, or raise "
        "vm.max_map_count (sysctl).",
        RuntimeWarning,
        stacklevel=3,
    )
