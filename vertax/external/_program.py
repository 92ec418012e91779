"""Running a program in a folder of its own, of which nothing stays."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from vertax.external._simulator import SimulatorError


def run_program(
    command: Sequence[str],
    files: Mapping[str, str],
    results: Sequence[str],
    *,
    timeout: float,
    install: str = "",
) -> tuple[dict[str, str], str]:
    """Run a program in a new folder, and read what it leaves there.

    **Arguments:**

    - `command`: the program and its arguments, in which files are those of the folder.
    - `files`: what to put into the folder, text by name.
    - `results`: names of the files that it is to write.
    - `timeout`: seconds after which it is ended, with all that it started.
    - `install`: what to tell somebody who does not have the program.

    **Returns:** the text of its results by name, and its log, which is all that it printed.

    **Raises:**

    - [`SimulatorError`][vertax.external.SimulatorError] with the tail of its log if it is not there,
        crashes, takes too long, or leaves a result out.
    """
    program = shutil.which(command[0])
    if program is None:
        raise SimulatorError(f"There is no program {command[0]!r} here. {install}".rstrip())
    with tempfile.TemporaryDirectory(prefix="vertax-") as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        log_path = folder / "log"
        with log_path.open("wb") as log:
            # What it keeps at home (a history of commands, say) goes with the folder.
            process = subprocess.Popen(
                [program, *command[1:]],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | {"HOME": name},
                start_new_session=True,
            )
            try:
                code = process.wait(timeout)
                reason = None if code == 0 else f"ended with {_exit(code)}"
            except subprocess.TimeoutExpired:
                reason = f"was not done after {timeout:g} s, and was ended"
            finally:
                _end(process)
        log_text = log_path.read_text(encoding="utf-8", errors="replace")
        found = {}
        for file in results:
            path = folder / file
            if reason is None and not path.is_file():
                reason = f"wrote no {file!r}"
            elif reason is None:
                found[file] = path.read_text(encoding="utf-8", errors="replace")
    if reason is not None:
        raise SimulatorError(f"{command[0]} {reason}. {tail(log_text)}")
    return found, log_text


def tail(log: str, lines: int = 12) -> str:
    """The end of a log, as a message quotes it."""
    last = [line for line in log.splitlines() if line.strip()][-lines:]
    if not last:
        return "It printed nothing."
    return "The end of what it printed:\n" + "\n".join(f"    {line[:200]}" for line in last)


def _exit(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    with suppress(ValueError):
        return f"signal {signal.Signals(-code).name}"
    return f"signal {-code}"


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program that still runs, and what it started."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
