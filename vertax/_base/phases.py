"""The name of the present phase of a long computation, on the terminal."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from tqdm import tqdm

# Seconds before the name appears.
_DELAY = 2.0


class _Thread(threading.local):
    bar: tqdm | None = None


_thread = _Thread()


@contextlib.contextmanager
def phases(number: int) -> Iterator[None]:
    """Show names of phases, of the given number, after 2 s: a context manager or a decorator.

    Only on a terminal and in the main thread: computations in several threads have another bar.
    """
    elsewhere = threading.current_thread() is not threading.main_thread()
    options = {"disable": True if elsewhere else None, "delay": _DELAY, "leave": False}
    with tqdm(total=number, bar_format="{desc} {n}/{total} [{elapsed}]", **options) as bar:
        _thread.bar = bar
        try:
            yield
        finally:
            _thread.bar = None


def start_phase(name: str) -> None:
    """Name the next phase."""
    if _thread.bar is not None:
        _thread.bar.set_description_str(name, refresh=False)
        _thread.bar.update()
        _thread.bar.refresh()
