"""Costs of many tasks: `python benchmarks/tasks.py [overhead speed-up masks continue classes]`.

- overhead: seconds until the first outcome, and milliseconds for each further one, of empty tasks.
- speed-up: seconds of 40 tasks of a fifth of a second of work, with one and with two local processes.
- masks: memory of the caller with many masks of 100 cells, without their inference, and of tables.
- continue: seconds to find that all masks and all runs of a sweep are finished.
- classes: seconds of a mask in a new process, without and with the compiled functions of another one, and in
    the same process again.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import distributed
import numpy as np
from _arguments import count
from masks import label_image

import vertax as vx
from vertax._base.processes import LocalProcesses
from vertax.runs._sweep import sweep, sweep_runs
from vertax.tensions import MaskFrame, _tensions_of_masks, infer_tensions, infer_tensions_of_masks


def overhead(options: argparse.Namespace) -> None:
    """Empty tasks."""
    print("| executor | first outcome | each further task |\n|---|---|---|")
    with ThreadPoolExecutor(2) as pool:
        measure("threads", pool, options.tasks)
    measure("local processes", None, options.tasks)
    cluster = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**cluster) as workers, distributed.Client(workers) as client:
        measure("two Dask workers", client.get_executor(), options.tasks)


def measure(name: str, executor: Executor | None, n: int) -> None:
    """Print a row for one executor."""
    began = time.perf_counter()
    outcomes = vx.map_tasks(abs, range(n), executor=executor, progress=False)
    next(outcomes)
    first = time.perf_counter()
    for _ in outcomes:
        pass
    further = 1e3 * (time.perf_counter() - first) / (n - 1)
    print(f"| {name} | {first - began:.1f} s | {further:.2f} ms |", flush=True)


def work(_: int) -> None:
    """A fifth of a second of one core."""
    end = time.process_time() + 0.2
    while time.process_time() < end:
        pass


def speed_up(options: argparse.Namespace) -> None:
    """One and two processes."""
    for workers in (1, 2):
        with LocalProcesses(workers) as pool:
            list(vx.map_tasks(abs, range(workers), executor=pool, progress=False))
            began = time.perf_counter()
            list(vx.map_tasks(work, range(40), executor=pool, progress=False))
            print(f"{workers} processes: {time.perf_counter() - began:.1f} s", flush=True)


def simulated(n: int) -> list[MaskFrame]:
    """Masks of one pixel, all different."""
    return [MaskFrame(k, np.full((1, 1), k)) for k in range(n)]


def masks(options: argparse.Namespace) -> None:
    """Memory of the caller, and the time of tables."""
    result = infer_tensions(label_image(100, 566, np.random.default_rng(0)))
    _tensions_of_masks._infer = lambda frame, options: result
    peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    with tempfile.TemporaryDirectory() as folder:
        for n in (64, options.masks):
            began = time.perf_counter()
            frames, cache = simulated(n), f"{folder}/cache{n}"
            tensions = infer_tensions_of_masks(frames, cache=cache, progress=False)
            stored = time.perf_counter() - began
            print(f"{n} masks: {stored:.0f} s, peak of memory {peak():.0f} MB", flush=True)
            for format in ("csv", "parquet"):
                began = time.perf_counter()
                files = tensions.write(f"{folder}/{format}{n}", format=format)
                seconds = time.perf_counter() - began
                size = sum(
                    f.stat().st_size for f in Path(files[0]).parent.rglob("*") if f.is_file()
                )
                print(
                    f"    {format}: {seconds:.0f} s, {size / 2**20:.0f} MB, peak {peak():.0f} MB",
                    flush=True,
                )


def continue_finished(options: argparse.Namespace) -> None:
    """A study of which everything is finished."""
    n = options.finished
    result = infer_tensions(label_image(100, 566, np.random.default_rng(0)))
    _tensions_of_masks._infer = lambda frame, options: result
    with tempfile.TemporaryDirectory() as name:
        cache, frames = Path(name) / "cache", simulated(n)
        infer_tensions_of_masks(frames[:1], cache=cache, progress=False)
        (entry,) = cache.iterdir()
        for frame in frames[1:]:
            shutil.copy(entry, cache / _tensions_of_masks._entry_name(frame, {}))
        began = time.perf_counter()
        tensions = infer_tensions_of_masks(frames, cache=cache, progress=False)
        print(f"{len(tensions.results)} finished masks: {time.perf_counter() - began:.1f} s")
        os.chdir(name)
        Path("tiny.toml").write_text('experiment = "infer_shape_factors"\n')
        grid = {"seed": [str(k) for k in range(n)]}
        for run in sweep_runs(["tiny.toml"], grid, "out"):
            run.folder.mkdir(parents=True)
            (run.folder / "metrics.json").write_text('{"cost_final": 1.0}')
        began = time.perf_counter()
        runs = sweep_runs(["tiny.toml"], grid, "out")
        sweep(runs, Path("out"), progress=False)
        print(f"{len(runs)} finished runs: {time.perf_counter() - began:.1f} s", flush=True)


# Run in a new process.
CLASS = """
import sys, time
import numpy as np
import vertax as vx
if sys.argv[2] != "off":
    vx.enable_compilation_cache(sys.argv[2])
seconds = []
for _ in range(2):
    start = time.perf_counter()
    result = vx.tensions.infer_tensions(np.load(sys.argv[1]))
    seconds.append(time.perf_counter() - start)
print("    first {:.1f} s, again {:.1f} s".format(*seconds), flush=True)
"""


def classes(options: argparse.Namespace) -> None:
    """A size class in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/mask.npy", label_image(100, 566, np.random.default_rng(0)))
        for label, cache in (
            ("no cache", "off"),
            ("an empty cache", f"{folder}/cache"),
            ("a cache of another process", f"{folder}/cache"),
        ):
            print(label, flush=True)
            subprocess.run([sys.executable, "-c", CLASS, f"{folder}/mask.npy", cache], check=True)


PARTS = {
    "overhead": overhead,
    "speed-up": speed_up,
    "masks": masks,
    "continue": continue_finished,
    "classes": classes,
}


def main() -> None:
    """Measure the parts that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="by default all")
    parser.add_argument("--tasks", type=count, default=1000, help="empty tasks")
    parser.add_argument("--masks", type=count, default=2000, help="masks of 100 cells")
    parser.add_argument("--finished", type=count, default=10000, help="finished masks and runs")
    options = parser.parse_args()
    for part in options.parts or PARTS:
        print(f"# {part}", flush=True)
        PARTS[part](options)


if __name__ == "__main__":
    main()
