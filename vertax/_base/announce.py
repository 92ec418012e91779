"""Messages on the terminal while a function compiles."""

from __future__ import annotations

import contextlib
import functools
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
from tqdm import tqdm

Function = TypeVar("Function", bound=Callable[..., Any])

DELAY = 1.0
"""Seconds of compilation after which a message is printed."""


class _Job:
    """The job that a message names, once."""

    def __init__(self, label: str):
        self.label = label
        self.announced = False


class _Thread(threading.local):
    job: _Job | None = None
    """The job of the message; None for no message."""
    timer: threading.Timer | None = None
    """Timer of the outermost compiled function that is being called."""


_thread = _Thread()
_label_of_process: list[str] = []


def announced_jit(function: Function, *, inline: bool = False, label: str = "") -> Function:
    """`equinox.filter_jit` with a message on a terminal while the function compiles.

    The message names the job of `announce_compilations`, or else `label`, by default the function.
    """
    label = label or f"`{function.__name__.strip('_')}`"

    # JAX calls this only to trace it: a compiled function does not start the timer.
    @functools.wraps(function)
    def traced(*args: Any, **kwargs: Any) -> Any:
        timer = _thread.timer
        if timer is not None and timer.ident is None:
            timer.start()
        return function(*args, **kwargs)

    jit: Any = eqx.filter_jit
    compiled = jit(traced, inline=inline)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        job = _thread.job
        if job is None and (_label_of_process or _is_watched()):
            job = _Job(_label_of_process[0] if _label_of_process else label)
        if job is None or job.announced or _thread.timer is not None:
            return compiled(*args, **kwargs)
        _thread.timer = threading.Timer(DELAY, _print_message, (job,))
        _thread.timer.daemon = True
        try:
            return compiled(*args, **kwargs)
        finally:
            _thread.timer.cancel()
            _thread.timer = None

    return call  # pyright: ignore[reportReturnType]


@contextlib.contextmanager
def announce_compilations(label: str) -> Iterator[None]:
    """Print "Compiling `label`" once when a compilation takes longer than `DELAY`.

    The message appears on a terminal and in a notebook; elsewhere only after `announce_in_this_process`.
    """
    before = _thread.job
    # The outermost context names the job that the user started.
    if before is None and (_is_watched() or _label_of_process):
        _thread.job = _Job(label)
    try:
        yield
    finally:
        _thread.job = before


def _is_watched() -> bool:
    return sys.stderr.isatty() or "ipykernel" in sys.modules


def announce_in_this_process(label: str) -> None:
    """Announce compilations in all threads, also without a terminal; `label` is the default name."""
    _label_of_process[:] = [label]


def _print_message(job: _Job) -> None:
    job.announced = True
    tqdm.write(f"Compiling {job.label} (once for each size and kind of tissue) …", file=sys.stderr)
