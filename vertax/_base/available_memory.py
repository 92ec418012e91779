"""The memory that is free, and a check before work that needs much of it."""

from __future__ import annotations

import os
from pathlib import Path


def available_memory() -> int:
    """Bytes that processes can still use; all of the machine where the system does not report them."""
    information = Path("/proc/meminfo")
    if information.exists():
        for line in information.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2**63


def check_memory(name: str, needed: float, remedy: str) -> None:
    """Raise a `MemoryError` if an argument needs more memory than is available."""
    available = available_memory()
    if needed > available:
        raise MemoryError(
            f"Argument `{name}` must fit in memory, but it takes about {needed / 2**30:.1f} GB and "
            f"{available / 2**30:.1f} GB are available. {remedy}"
        )
