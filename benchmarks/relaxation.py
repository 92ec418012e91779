"""Relaxations and fits of many kinds; with `--against FOLDER`, another checkout beside this one.

A row for each case and checkout: members at rest, overlaps (brute force, up to 400 cells), means of steps, of
Hessian-vector products (where the checkout counts them) and of energies, the mean and the median processor
time of a relaxation, kernels (fusions of the compiled program), and processor time of tracing and
compilation. Cases called "epochs" are fits: the time is that of an epoch.

Each checkout runs in a separate process; the processes take turns, seed by seed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import vertax as vx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from brute_force_overlaps import faces_that_overlap  # pyright: ignore[reportMissingImports]

jax.config.update("jax_enable_x64", True)

Case = Callable[[int], tuple[vx.Tissue, vx.AbstractEnergy]]


def shapes(n_cells: int, shape_factor: float) -> Case:
    """A periodic tissue with target shape factors of standard deviation 0.1."""

    def case(seed: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
        tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(seed))
        noise = jax.random.normal(jax.random.key(1000 + seed), (n_cells,))
        return tissue, vx.energies.ShapeFactorEnergy(shape_factor + 0.1 * noise)

    return case


def tensions(n_cells: int, ratio: float) -> Case:
    """A periodic tissue of elastic areas with line tensions between 0.1 and 0.1 times a ratio."""

    def case(seed: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
        tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(seed))
        size = (tissue.n_edges,)
        tension = 0.1 * ratio ** jax.random.uniform(jax.random.key(1000 + seed), size)
        elastic = vx.energies.AreaElasticity(1.0, jnp.ones(n_cells))
        return tissue, elastic + vx.energies.LineTension(tension)

    return case


def cluster(n_cells: int) -> Case:
    """A free cluster in which all edges are arcs."""

    def case(seed: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
        key = jax.random.key(seed)
        tissue = vx.initialise.free_voronoi(n_cells, key=key, lloyd_steps=3, inner_arcs=True)
        noise = jax.random.normal(jax.random.key(1000 + seed), (tissue.n_edges,))
        elastic = vx.energies.AreaElasticity(20.0, jnp.ones(n_cells))
        return tissue, elastic + vx.energies.LineTension(1 + 0.2 * noise)

    return case


CASES: dict[str, tuple[Case, int]] = {
    "20 cells, p0 = 3.7": (shapes(20, 3.7), 20),
    **{f"100 cells, p0 = {p0}": (shapes(100, p0), 10) for p0 in (3.5, 3.7, 3.8, 3.9)},
    **{f"64 cells, p0 = {p0}": (shapes(64, p0), 10) for p0 in (4.1, 4.5)},
    **{f"100 cells, tensions 1 : {r}": (tensions(100, r), 10) for r in (3, 10)},
    "30 cells, arcs": (cluster(30), 5),
    "400 cells, p0 = 3.7": (shapes(400, 3.7), 3),
    "400 cells, tensions 1 : 10": (tensions(400, 10), 3),
    **{f"1000 cells, p0 = {p0}": (shapes(1000, p0), 2) for p0 in (3.7, 3.9)},
    "10000 cells, p0 = 3.7": (shapes(10_000, 3.7), 1),
    **{f"epochs, {n} cells": (shapes(n, 3.7), 3) for n in (20, 100)},
}
"""Cases with their numbers of seeds."""
N_EPOCHS = 60


def equilibrium(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.Equilibrium:
    """A relaxation of at most 2000 steps."""
    return vx.equilibrate(tissue, energy, throw=False)


def products(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
    """Hessian-vector products of a relaxation."""
    relaxation: Any = vx.Relaxation().traced()
    search = relaxation.search(tissue, energy)
    end = search.advance(search.begin(tissue, energy), energy, relaxation.max_steps)
    return end.iteration.num_products


class Program:
    """The compiled program of a case in this process."""

    def __init__(self, name: str):
        self.case, _ = CASES[name]
        given = self.case(0)
        start = time.process_time()
        jitted: Any = eqx.filter_jit(equilibrium)
        self.run = jitted.lower(*given).compile()
        self.compile_seconds = time.process_time() - start
        self.kernels = (self.run.compiled.as_text() or "").count(" fusion(")
        self.count: Any = eqx.filter_jit(products)
        jax.block_until_ready(self.run(*given))

    def row(self, seed: int) -> dict[str, float]:
        """One relaxation."""
        given = jax.block_until_ready(self.case(seed))
        start = time.process_time()
        end = jax.block_until_ready(self.run(*given))
        seconds = time.process_time() - start
        row = {
            "at rest": float(end.converged),
            "steps": float(end.num_steps),
            "energy": float(end.energy),
            "ms": 1e3 * seconds,
            "kernels": self.kernels,
            "compile s": self.compile_seconds,
        }
        # (The check by brute force takes too long for large tissues.)
        if end.tissue.n_cells <= 400:
            row["overlaps"] = float(bool(faces_that_overlap(end.tissue)))
            with contextlib.suppress(AttributeError):  # a checkout that does not count them
                row["products"] = float(self.count(*given))
        return row


class Epochs:
    """A fit in this process."""

    optimiser = optax.adam(1e-2)

    def __init__(self, name: str):
        self.case, _ = CASES[name]
        start = time.process_time()
        self.fit(0, 2)
        self.compile_seconds = time.process_time() - start

    def fit(self, seed: int, n_epochs: int) -> vx.fitting.Fit:
        """A fit of shape factors to the vertices of a relaxed tissue."""
        tissue, truth = self.case(seed)
        target = vx.equilibrate(tissue, truth).tissue
        energy = vx.energies.ShapeFactorEnergy(jnp.full(tissue.n_cells, 3.7))
        problem = vx.InverseProblem(target, energy, vx.costs.VertexDistance(target))
        return vx.fit(problem, self.optimiser, n_epochs, progress=False)

    def row(self, seed: int) -> dict[str, float]:
        """One fit."""
        start = time.process_time()
        self.fit(seed, 2)
        middle = time.process_time()
        history = self.fit(seed, 2 + N_EPOCHS).history
        seconds = time.process_time() - middle - (middle - start)
        return {
            "steps": float(np.mean(history.num_steps[1:])),
            "ms": 1e3 * seconds / N_EPOCHS,
            "compile s": self.compile_seconds,
        }


def serve() -> None:
    """Answer requests, each a line with the name of a case and a seed."""
    programs: dict[str, Program | Epochs] = {}
    for line in sys.stdin:
        name, seed = json.loads(line)
        if name not in programs:
            programs.clear()
            programs[name] = Epochs(name) if name.startswith("epochs") else Program(name)
        print(json.dumps(programs[name].row(seed)), flush=True)


class Checkout:
    """A process that runs the cases with the code of a folder."""

    def __init__(self, folder: Path):
        self.name = folder.name
        environment = os.environ | {"PYTHONPATH": str(folder), "VERTAX_CACHE": "off"}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        command = [sys.executable, __file__, "--serve"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=folder
        )

    def row(self, name: str, seed: int) -> dict[str, float]:
        """One relaxation of a case."""
        asked, answered = self.process.stdin, self.process.stdout
        assert asked is not None
        assert answered is not None
        print(json.dumps([name, seed]), file=asked, flush=True)
        answer = answered.readline()
        if not answer:
            sys.exit(f"The process of {self.name} has ended.")
        return json.loads(answer)


def summary(rows: list[dict[str, float]]) -> str:
    """The row of a case; NaN for what a case or a checkout does not have."""
    of = lambda name, reduced=np.mean: reduced([row.get(name, np.nan) for row in rows])
    return (
        f"{of('at rest'):5.0%} {of('overlaps', np.sum):4.0f} | {of('steps'):6.1f} "
        f"{of('products'):8.0f} {of('energy'):10.4f} | {of('ms'):9.2f} {of('ms', np.median):9.2f} | "
        f"{of('kernels'):5.0f} {of('compile s'):6.1f}"
    )


def main() -> None:
    """Print a row for each case and checkout."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=[""], help="parts of the names of cases")
    parser.add_argument("--against", type=Path, nargs="*", default=[], help="other checkouts")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.serve:
        serve()
        return
    for part in chosen.cases:
        if not any(part in name for name in CASES):
            parser.error(f"argument --cases: {part!r} is part of no name; there are {list(CASES)}")
    for folder in chosen.against:
        if not (folder / "vertax").is_dir():
            parser.error(f"argument --against: {folder} has no folder vertax")
    folders = [Path(vx.__file__).resolve().parents[1], *chosen.against]
    checkouts = [Checkout(folder.resolve()) for folder in folders]
    head = "at rest, overlaps | steps, products, energy | ms: mean, median | kernels, compile s"
    print(f"{'case':>28} {'checkout':>16} | {head}", flush=True)
    for name, (_, n_seeds) in CASES.items():
        if not any(part in name for part in chosen.cases):
            continue
        rows = [[c.row(name, seed) for c in checkouts] for seed in range(n_seeds)]
        for checkout, results in zip(checkouts, zip(*rows, strict=True), strict=True):
            print(f"{name:>28} {checkout.name:>16} | {summary(list(results))}", flush=True)


if __name__ == "__main__":
    main()
