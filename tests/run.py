"""Run the tests, one process a folder: `python tests/run.py [--workers 2] [options of pytest]`.

Tests compile a lot, and a process that has compiled very much dies in the compiler. So each folder of tests
has a process of its own, and so have the files that compile most; `--workers` of them run at a time. What
they print comes in one piece, when they are done.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
# Four fifths of the time goes into compiling. What one process has compiled the others find, and the next
# run of the tests as well; the key of each function is all of its code, flags and versions included.
CACHE = {
    "JAX_COMPILATION_CACHE_DIR": str(FOLDER.parent / ".cache" / "tests"),
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(2 * 1024**3),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
}
# What takes longest begins first, and the others fill up the end.
LONGEST = (
    "adjoints",
    "project",
    "fitting",
    "responses/test_free_equilibrium.py",
    "responses/test_relaxation.py",
    "costs",
    "responses",
    "experiments/test_topologies_and_rigidity.py",
    "runs",
    "experiments/test_designs.py",
    "transitions",
    "mesh",
    "solvers",
    "experiments",
)
NOTHING_SELECTED = 5


def groups() -> list[list[Path]]:
    """The files of tests that share a process."""
    shared: dict[str, list[Path]] = {}
    for file in sorted(FOLDER.rglob("test_*.py")):
        name = file.relative_to(FOLDER).as_posix()
        group = name if name in LONGEST else file.parent.name
        shared.setdefault(group, []).append(file)
    place = lambda name: LONGEST.index(name) if name in LONGEST else len(LONGEST)
    return [shared[name] for name in sorted(shared, key=place)]


def run(files: list[Path], options: list[str]) -> tuple[int, str]:
    """The exit code of pytest, and the line that counts its tests."""
    names = [str(file.relative_to(FOLDER.parent)) for file in files]
    command = [sys.executable, "-m", "pytest", "-p", "no:xdist", *options, *names]
    outcome = subprocess.run(
        command,
        cwd=FOLDER.parent,
        env=CACHE | os.environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    what = names[0] if len(names) == 1 else f"{Path(names[0]).parent} ({len(names)} files)"
    print(f"\n--- {what}\n{outcome.stdout.rstrip()}", flush=True)
    return outcome.returncode, (outcome.stdout.rstrip().splitlines() or [""])[-1]


def main() -> int:
    """Run all tests; the exit code is 0 if all passed."""
    parser = argparse.ArgumentParser(description="Run the tests.", allow_abbrev=False)
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    chosen, options = parser.parse_known_args()
    began = time.perf_counter()
    with ThreadPoolExecutor(chosen.workers) as pool:
        outcomes = list(pool.map(lambda files: run(files, options), groups()))
    count: Counter[str] = Counter()
    for _, line in outcomes:
        for number, what in re.findall(
            r"(\d+) (passed|failed|skipped|xfailed|deselected|errors?)", line
        ):
            count[what] += int(number)
    failed = [code for code, _ in outcomes if code not in (0, NOTHING_SELECTED)]
    total = ", ".join(f"{number} {what}" for what, number in count.items())
    broken = f"; {len(failed)} of {len(outcomes)} processes failed" if failed else ""
    print(f"\n{total} in {time.perf_counter() - began:.0f} s{broken}")
    return 1 if failed or not count["passed"] else 0


if __name__ == "__main__":
    sys.exit(main())
