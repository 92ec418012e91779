"""Relaxations of many kinds: fraction converged, overlaps (brute force), steps, time, kernels, compile time.

To compare with another version run this file again with PYTHONPATH set to its folder. Kernels are the
fusions of the compiled program, as in `compilation.py`. Seconds of tracing and compilation are 0 where an
earlier case has compiled the same program.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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
    **{f"100 cells, p0 = {p0}": (shapes(100, p0), 10) for p0 in (3.5, 3.7, 3.8, 3.9)},
    **{f"64 cells, p0 = {p0}": (shapes(64, p0), 10) for p0 in (4.1, 4.5)},
    **{f"100 cells, tensions 1 : {r}": (tensions(100, r), 10) for r in (3, 10)},
    "30 cells, arcs": (cluster(30), 5),
    "400 cells, p0 = 3.7": (shapes(400, 3.7), 3),
    "400 cells, tensions 1 : 10": (tensions(400, 10), 3),
    **{f"1000 cells, p0 = {p0}": (shapes(1000, p0), 2) for p0 in (3.7, 3.9)},
    "10000 cells, p0 = 3.7": (shapes(10_000, 3.7), 1),
}
"""Cases with their numbers of seeds."""


def equilibrium(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.Equilibrium:
    """A relaxation of at most 2000 steps."""
    return vx.equilibrate(tissue, energy, throw=False)


relax: Any = eqx.filter_jit(equilibrium)


def row(name: str, case: Case, n_seeds: int) -> str:
    """The results of one case."""
    given = jax.block_until_ready(case(0))
    began = time.perf_counter()
    lowered = relax.lower(*given)
    traced = time.perf_counter()
    program = lowered.compile()
    compiled = time.perf_counter()
    kernels = (program.compiled.as_text() or "").count(" fusion(")
    ends, seconds = [], []
    for seed in range(n_seeds):
        given = jax.block_until_ready(case(seed))
        start = time.perf_counter()
        ends.append(jax.block_until_ready(program(*given)))
        seconds.append(time.perf_counter() - start)
    at_rest = np.mean([bool(e.converged) for e in ends])
    # The check by brute force takes too long for large tissues.
    checked = [e for e in ends if e.tissue.n_cells <= 400]
    overlap = sum(bool(faces_that_overlap(e.tissue)) for e in checked)
    steps = np.mean([int(e.num_steps) for e in ends])
    energy = np.mean([float(e.energy) for e in ends])
    median, mean = 1e3 * np.median(seconds), 1e3 * np.mean(seconds)
    return (
        f"{name:>28} | {at_rest:5.0%} {overlap:4d} | {steps:6.1f} {median:8.1f} {mean:8.1f} "
        f"{energy:10.4f} | {kernels:5d} {traced - began:6.1f} {compiled - traced:6.1f}"
    )


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=[""], help="parts of the names of cases")
    chosen = parser.parse_args()
    for part in chosen.cases:
        if not any(part in name for name in CASES):
            parser.error(f"argument --cases: {part!r} is part of no name; there are {list(CASES)}")
    head = "at rest, overlaps | steps, median ms, mean ms, energy | kernels, trace s, compile s"
    print(f"{vx.__file__}\n{'case':>28} | {head}")
    for name, (case, n_seeds) in CASES.items():
        if any(part in name for part in chosen.cases):
            print(row(name, case, n_seeds), flush=True)


if __name__ == "__main__":
    main()
