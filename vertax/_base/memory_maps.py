"""A guard against more compiled functions than Linux lets a process keep."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from vertax._base.modules import is_concrete

MAPS = Path("/proc/self/maps")
MOST = Path("/proc/sys/vm/max_map_count")
SHARE = 0.7
"""Which share of them one may have: the next function may need some thousands."""
PAUSE = 1.0
"""Seconds from one look to the next, which takes milliseconds."""

_last_look = 0.0


def memory_maps() -> int:
    """How many memory maps this process has; 0 where that cannot be seen."""
    return MAPS.read_bytes().count(b"\n") if MAPS.exists() else 0


def forget_compiled() -> None:
    """Forget all compiled functions."""
    eqx.clear_caches()
    jax.clear_caches()


def spare_memory_maps() -> None:
    """Forget all compiled functions if there are nearly too many, and say so.

    Each function that XLA compiles for a CPU holds some memory maps of the process, and a gradient of one
    size of tissue is more than a thousand of them. Linux allows 65530; at the next one LLVM finds no memory
    and the process dies by a segmentation fault. To be called before something may be compiled; within a
    trace it does nothing.
    """
    global _last_look
    now = time.monotonic()
    # (What is made within a trace is traced.)
    if now - _last_look < PAUSE or not is_concrete(jnp.zeros(())):
        return
    _last_look = now
    try:
        most = int(MOST.read_text())
    except (OSError, ValueError):
        return  # no Linux
    count = memory_maps()
    if not count or count < SHARE * most:
        return
    forget_compiled()
    warnings.warn(
        f"This process held {count} memory maps of the {most} that the system allows, most of them for "
        "compiled functions. These were all forgotten, and what is used again is compiled again. Use "
        "fewer sizes of tissue in one process, or raise vm.max_map_count (sysctl).",
        RuntimeWarning,
        stacklevel=3,
    )
