"""Run the tests in several processes: `python tests/run.py [--workers 2] [options of pytest]`.

A process that compiles too many functions runs out of memory maps and crashes in the compiler. Therefore the
folders of tests are distributed over processes, of which `--workers` run at the same time. The output of each
process is printed when it ends.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
# Compilation takes 80 % of the time. Processes and later runs share compiled functions in this cache; its
# keys contain the code of the function, the flags and the versions.
CACHE = {
    "JAX_COMPILATION_CACHE_DIR": str(FOLDER.parent / ".cache" / "tests"),
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(2 * 1024**3),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
}
# Each row is a process: folders, and single files that are taken out of their folder. A process takes seven
# seconds to start. The longest ones come first.
TOGETHER = (
    ("project", "solvers"),
    ("bayes", "initialise", "runs"),
    ("inference", "tensions"),
    ("_base", "mesh", "energies", "dissipations", "surfaces"),
    ("adjoints", "external", "costs", "mechanics"),
    ("relax",),
    ("transitions", "growth", "signals", "dynamics", "activities"),
    ("io", "plotting", "precondition"),
    ("default_mode",),
    ("fitting",),
    ("project/test_spare_slots.py",),
    ("experiments",),
    ("experiments/test_designs.py", "experiments/test_topologies_and_rigidity.py"),
    ("debug_modes",),
)
# Tests of this folder run as users run JAX: in float32, with the normal optimisation of XLA.
DEFAULT_MODE = "default_mode"
NOTHING_SELECTED = 5


def groups(only: Sequence[str] = (), without: Sequence[str] = ()) -> list[list[Path]]:
    """The files of tests that share a process.

    **Arguments:**

    - `only`: prefixes of paths, relative to `tests/`; files with none of them are left out. By default all
        files are kept.
    - `without`: prefixes of paths; files with one of them are left out.
    """
    place = {name: number for number, names in enumerate(TOGETHER) for name in names}
    shared: dict[int, list[Path]] = {}
    for file in sorted(FOLDER.rglob("test_*.py")):
        name, folder = (path.relative_to(FOLDER).as_posix() for path in (file, file.parent))
        if name.startswith(tuple(only) or "") and not name.startswith(tuple(without)):
            number = place.get(name, place.get(folder, len(TOGETHER)))
            shared.setdefault(number, []).append(file)
    return [files for _, files in sorted(shared.items())]


def run(files: list[Path], options: list[str]) -> tuple[int, str]:
    """The exit code of pytest, and the line that counts its tests."""
    names = [str(file.relative_to(FOLDER.parent)) for file in files]
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", *options, *names]
    default = any(file.parent.name == DEFAULT_MODE for file in files)
    process = subprocess.run(
        command,
        cwd=FOLDER.parent,
        env=CACHE | os.environ | ({"VERTAX_TESTS_DEFAULT_MODE": "1"} if default else {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    folders = ", ".join(sorted({str(Path(name).parent) for name in names}))
    what = names[0] if len(names) == 1 else f"{folders} ({len(names)} files)"
    print(f"\n--- {what}\n{process.stdout.rstrip()}", flush=True)
    return process.returncode, (process.stdout.rstrip().splitlines() or [""])[-1]


def main() -> int:
    """Run all tests; the exit code is 0 if all passed."""
    parser = argparse.ArgumentParser(description="Run the tests.", allow_abbrev=False)
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        help="folder or file of tests, without `tests/`; may be repeated",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        help="folder or file of tests to leave out; may be repeated",
    )
    chosen, options = parser.parse_known_args()
    began = time.perf_counter()
    with ThreadPoolExecutor(chosen.workers) as pool:
        results = list(
            pool.map(lambda files: run(files, options), groups(chosen.only, chosen.without))
        )
    count: Counter[str] = Counter()
    for _, line in results:
        for number, what in re.findall(
            r"(\d+) (passed|failed|skipped|xfailed|deselected|errors?)", line
        ):
            count[what] += int(number)
    failed = [code for code, _ in results if code not in (0, NOTHING_SELECTED)]
    total = ", ".join(f"{number} {what}" for what, number in count.items())
    broken = f"; {len(failed)} of {len(results)} processes failed" if failed else ""
    print(f"\n{total} in {time.perf_counter() - began:.0f} s{broken}")
    return 1 if failed or not count["passed"] else 0


if __name__ == "__main__":
    sys.exit(main())
