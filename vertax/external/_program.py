"""Run a program in a temporary folder."""

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
    """Run a program in a temporary folder, and read its results.

    **Arguments:**

    - `command`: the program and its arguments; paths are relative to the folder.
    - `files`: input files, text by name.
    - `results`: names of the output files.
    - `timeout`: seconds after which the program and its child processes are killed.
    - `install`: a sentence for the error message if the program is not installed.

    **Returns:** the text of the output files by name, and the log, everything that the program printed.

    **Raises:**

    - [`SimulatorError`][vertax.external.SimulatorError] with the end of the log if the program is not
        installed, crashes, exceeds the timeout, or does not write a result.
    """
    program = shutil.which(command[0])
    if program is None:
        raise SimulatorError(f"There is no program {command[0]!r}. {install}".rstrip())
    with tempfile.TemporaryDirectory(prefix="vertax-") as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        log_path = folder / "log"
        with log_path.open("wb") as log:
            # Files in the home directory, such as a history of commands, are deleted with the folder.
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
                reason = f"was not done after {timeout:g} s, and was killed"
            finally:
                _end(process)
        log_text = log_path.read_text(encoding="utf-8", errors="replace")
        texts = {}
        for file in results:
            path = folder / file
            if reason is None and not path.is_file():
                reason = f"wrote no {file!r}"
            elif reason is None:
                texts[file] = path.read_text(encoding="utf-8", errors="replace")
    if reason is not None:
        raise SimulatorError(f"{command[0]} {reason}. {tail(log_text)}")
    return texts, log_text


def tail(log: str, lines: int = 12) -> str:
    """The last lines of a log, for an error message."""
    last = [line for line in log.splitlines() if line.strip()][-lines:]
    if not last:
        return "It printed nothing."
    return "The end of its output:\n" + "\n".join(f"    {line[:200]}" for line in last)


def _exit(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    with suppress(ValueError):
        return f"signal {signal.Signals(-code).name}"
    return f"signal {-code}"


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a running program and its child processes."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
