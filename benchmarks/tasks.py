"""Overhead of tasks on executors: `python benchmarks/tasks.py [--tasks 1000]`.

Prints seconds until the first outcome, and milliseconds for each further task, of tasks that do nothing.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import Executor, ThreadPoolExecutor

import distributed
from _arguments import count

import vertax as vx


def measure(name: str, executor: Executor | None, n: int) -> None:
    """Print a row for one executor."""
    began = time.perf_counter()
    outcomes = vx.map_tasks(abs, range(n), executor=executor, progress=False)
    next(outcomes)
    first = time.perf_counter()
    for _ in outcomes:
        pass
    last = time.perf_counter()
    print(
        f"| {name} | {first - began:.1f} s | {1e3 * (last - first) / (n - 1):.2f} ms |", flush=True
    )


def main() -> None:
    """Measure threads, local processes and a local Dask cluster."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=count, default=1000, help="number of tasks")
    n = parser.parse_args().tasks
    print("| executor | first outcome | each further task |\n|---|---|---|")
    with ThreadPoolExecutor(2) as pool:
        measure("threads", pool, n)
    measure("local processes", None, n)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        measure("two Dask workers", client.get_executor(), n)


if __name__ == "__main__":
    main()
