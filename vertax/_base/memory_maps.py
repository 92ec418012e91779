"""A warning before a process has more compiled functions than Linux lets it keep."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import jax.numpy as jnp

from vertax._base.tracing import is_concrete

MAPS = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
FRACTION = 0.7
"""Fraction of the limit at which to warn: the next function may need some thousands."""
INTERVAL = 1.0
"""Seconds between two counts, each of which takes milliseconds."""

_last_count = 0.0
_has_warned = False


def memory_maps() -> int:
    """Number of memory maps of this process; 0 where the system does not list them."""
    return MAPS.read_bytes().count(b"\n") if MAPS.exists() else 0


def warn_of_memory_maps() -> None:
    """Warn, once in a process, if compiled functions hold nearly all memory maps that the system allows.

    Each function that XLA compiles for a CPU holds some memory maps of the process, and a gradient of one
    size of tissue is more than a thousand of them. Linux allows 65530; beyond, LLVM cannot allocate memory
    and the process ends by a segmentation fault. Call this before a compilation; inside a trace it does
    nothing.
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
