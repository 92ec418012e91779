"""Linear algebra of NumPy and SciPy in one thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import threadpoolctl

_lock = threading.Lock()
_limits: list[Any] = []
_users: list[None] = []


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread: a context manager or a decorator.

    Threads of BLAS wait in busy loops. With matrices of some hundred rows on two cores in use by other
    programs, two threads took 6 to 10 times as long as one. The limit is that of the process, and ends with
    the last of several concurrent calls.
    """
    with _lock:
        if not _users:
            _take_control()
            _limits.append(threadpoolctl.threadpool_limits(1, "blas"))
        _users.append(None)
    try:
        yield
    finally:
        with _lock:
            _users.pop()
            if not _users:
                _take_control()
                _limits.pop().restore_original_limits()


def _take_control() -> None:
    """Let this thread set the limit: newer versions of threadpoolctl ignore all but the first.

    They do so without an error: the limit would not begin, or not end with the last of several calls.
    """
    release = getattr(threadpoolctl.OpenBLASController, "clear_controlling_thread", None)
    if release is not None:
        release(force=True)
