"""Fraction of random tissues that reach equilibrium, and that overlap there, with contacts and without.

Overlaps are ends by brute force, with the function of the tests.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _arguments import count

import vertax as vx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from brute_force_overlaps import faces_that_overlap  # pyright: ignore[reportMissingImports]

jax.config.update("jax_enable_x64", True)

Cases = Iterator[tuple[vx.Tissue, vx.AbstractEnergy]]
BOXES = {
    "square": np.eye(2),
    "sheared": np.array([[1.0, 0.0], [0.5, 1.0]]),
    "3 : 1": np.diag([3**0.5, 3**-0.5]),
}


@eqx.filter_jit
def relax(tissue: vx.Tissue, energy: vx.AbstractEnergy, reach: jax.Array | None) -> vx.Equilibrium:
    """A relaxation of at most 2000 steps."""
    return vx.equilibrate(tissue, energy, contact_range=reach, throw=False)


def row(name: str, cases: list[tuple[vx.Tissue, vx.AbstractEnergy]]) -> None:
    """Relax all cases, without contacts and with them, and print a row of results."""
    text = f"{name:>34}"
    medians = []
    for reach in (None, jnp.asarray(0.01)):
        jax.block_until_ready(relax(*cases[0], reach).energy)
        ends, seconds = [], []
        for tissue, energy in cases:
            began = time.perf_counter()
            ends.append(jax.block_until_ready(relax(tissue, energy, reach)))
            seconds.append(time.perf_counter() - began)
        at_rest = np.mean([bool(e.result == vx.RESULTS.successful) for e in ends])
        overlap = np.mean([bool(faces_that_overlap(e.tissue)) for e in ends])
        steps = np.array([int(e.num_steps) for e in ends])
        medians.append(np.median(seconds))
        text += f" | {at_rest:7.1%} {overlap:7.1%} {np.median(steps):5.0f} {steps.max():5d}"
    print(f"{text} | {medians[1] / medians[0]:5.2f}", flush=True)


def main() -> None:
    """Print one row for each kind of tissue."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tissues", type=count, default=100)
    parser.add_argument("--cells", type=count, default=64)
    parser.add_argument(
        "--only", default="", help="a regular expression that the names of rows match"
    )
    chosen = parser.parse_args()
    n, n_cells = chosen.tissues, chosen.cells
    print(f"{n} tissues of {n_cells} cells each; max_steps=2000")
    columns = f"{'at rest':>7} {'overlap':>7} {'steps':>5} {'most':>5}"
    print(f"{'':>34} | {'without contacts':^27} | {'with':^27} | times")
    print(f"{'':>34} | {columns} | {columns} | as long")
    side = n_cells**0.5

    def shapes(seed: int, mean: float, spread: float) -> vx.AbstractEnergy:
        p0 = np.random.default_rng(seed).normal(mean, spread, n_cells)
        return vx.energies.ShapeFactorEnergy(jnp.asarray(p0))

    def tension(tissue: vx.Tissue, seed: int) -> vx.AbstractEnergy:
        gamma = np.random.default_rng(seed).uniform(0.06, 0.6, tissue.n_edges)
        lines = vx.energies.LineTension(jnp.asarray(gamma))
        return vx.energies.AreaElasticity(2.0, 1.0) + lines

    def periodic(box: str) -> Iterator[vx.Tissue]:
        lattice = side * BOXES[box]
        return (vx.initialise.periodic_voronoi(n_cells, key=s, lattice=lattice) for s in range(n))

    def shaped(mean: float, spread: float, box: str) -> Cases:
        return ((t, shapes(s, mean, spread)) for s, t in enumerate(periodic(box)))

    def tense(tissues: Iterator[vx.Tissue]) -> Cases:
        return ((t, tension(t, s)) for s, t in enumerate(tissues))

    rows: dict[str, Callable[[], Cases]] = {}
    for spread in (0.0, 0.1):
        for mean in (3.0, 3.5, 3.7, 3.8, 3.9, 4.0, 4.1, 4.5):
            rows[f"p0 = {mean}, s.d. {spread}"] = partial(shaped, mean, spread, "square")
    for box in ("sheared", "3 : 1"):
        for mean in (3.8, 4.1):
            rows[f"p0 = {mean}, s.d. 0.1, {box} box"] = partial(shaped, mean, 0.1, box)
    rows["line tensions of ratio 10"] = lambda: tense(periodic("square"))
    few = max(n_cells // 2, 2)
    rows["the same, free, half as many cells"] = lambda: tense(
        vx.initialise.free_voronoi(few, key=s) for s in range(n)
    )
    for name, cases in rows.items():
        if re.search(chosen.only, name):
            row(name, list(cases()))


if __name__ == "__main__":
    main()
