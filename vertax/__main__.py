"""The command `vertax`, which is `python -m vertax` as well."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading

from vertax._base.extras import requires_extra

_INTERRUPTED = 130  # the exit code of a program that SIGINT ended, 128 + 2


def main() -> None:
    """Entry point of the program `vertax`."""
    interrupted = threading.Event()
    # Functions run at exit in reverse order. This one is registered before any other module is imported, so
    # it runs last: pools of processes are shut down and log files are flushed before it.
    atexit.register(_skip_finalisation, interrupted)
    try:
        with requires_extra("run", "The command `vertax`"):
            from vertax.runs.command_line import app
        app()
    except SystemExit as stop:
        if stop.code == _INTERRUPTED:
            interrupted.set()
        raise
    except KeyboardInterrupt:  # while the command itself was imported
        interrupted.set()
        sys.exit(_INTERRUPTED)
    except ImportError as error:
        if "pip install" not in str(error):
            raise
        sys.exit(f"Error: {error}")  # an extra is missing, here or in what a command imports


def _skip_finalisation(interrupted: threading.Event) -> None:
    """End an interrupted process without destroying the objects of its modules.

    An interrupt that arrives while JAX compiles is raised when the compilation returns. JAX 0.10 then
    crashes with a segmentation fault when Python destroys its modules at exit, also in a script of JAX
    alone, and the exit code would be that of the crash.
    """
    if interrupted.is_set():
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(
                OSError, ValueError
            ):  # the reader of a pipe is gone, or it is closed
                stream.flush()
        os._exit(_INTERRUPTED)


if __name__ == "__main__":
    main()
