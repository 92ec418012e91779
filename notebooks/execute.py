"""Execute the notebooks: `python notebooks/execute.py --help`."""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parent


def execute(path: Path, timeout: int) -> NotebookNode:
    """Execute a notebook from its first cell to its last in a new process."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=timeout,
        resources={"metadata": {"path": str(FOLDER)}},
        extra_arguments=["--log-level=40"],  # errors, and no warnings
    )
    client.execute()
    return tidied(notebook)


def tidied(notebook: NotebookNode) -> NotebookNode:
    """Remove what differs between runs or machines, so that a diff shows only changes.

    These are metadata, and messages that a function compiles, which slow machines print.
    """
    notebook.metadata = NotebookNode(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number:02d}"
        cell.metadata = NotebookNode()
        outputs = cell.get("outputs", [])
        outputs[:] = [each for each in outputs if not is_message_of_compilation(each)]
    return notebook


def is_message_of_compilation(output: NotebookNode) -> bool:
    """Whether an output is the message of vertax that a function compiles."""
    return output.get("name") == "stderr" and output.text.startswith("Compiling ")


def main() -> None:
    """Execute some notebooks, or all; stop at the first error."""
    parser = argparse.ArgumentParser(description="Execute the notebooks.")
    parser.add_argument("notebooks", nargs="*", type=Path, help="paths; all by default")
    parser.add_argument("--light", action="store_true", help="fewer epochs, smaller tissues")
    parser.add_argument("--write", action="store_true", help="keep the outputs in the notebooks")
    parser.add_argument("--timeout", type=int, default=600, help="seconds for a cell, at most")
    parser.add_argument("--jobs", type=int, default=1, help="how many at a time")
    options = parser.parse_args()
    if options.light and options.write:
        parser.error("the outputs that are kept are those of the full setting")
    if options.light:
        os.environ["VERTAX_LIGHT"] = "1"
        # Compilation takes most of the time.
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_optimization_level=1"
    else:
        os.environ.pop("VERTAX_LIGHT", None)

    def one(path: Path) -> None:
        began = time.perf_counter()
        notebook = execute(path, options.timeout)
        print(f"{path.name}: {time.perf_counter() - began:.0f} s", flush=True)
        if options.write:
            nbformat.write(notebook, path)

    # Threads, because each notebook runs in a separate process.
    with ThreadPoolExecutor(options.jobs) as pool:
        for _ in pool.map(one, options.notebooks or sorted(FOLDER.glob("*.ipynb"))):
            pass


if __name__ == "__main__":
    main()
