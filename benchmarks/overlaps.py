"""Share of random tissues that come to rest, and that overlap there, with contacts and without.

What overlaps is judged by brute force, with the check of the tests.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import vertax as vx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from tilings import faces_that_overlap  # pyright: ignore[reportMissingImports]

jax.config.update("jax_enable_x64", True)

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
    """Relax all, without contacts and with them, and print what came out."""
    text = f"{name:>34}"
    medians = []
    for reach in (None, jnp.asarray(0.01)):
        jax.block_until_ready(relax(*cases[0], reach).energy)
        found, seconds = [], []
        for tissue, energy in cases:
            began = time.perf_counter()
            found.append(jax.block_until_ready(relax(tissue, energy, reach)))
            seconds.append(time.perf_counter() - began)
        at_rest = np.mean([bool(e.result == optx.RESULTS.successful) for e in found])
        overlap = np.mean([bool(faces_that_overlap(e.tissue)) for e in found])
        steps = np.array([int(e.num_steps) for e in found])
        medians.append(np.median(seconds))
        text += f" | {at_rest:7.1%} {overlap:7.1%} {np.median(steps):5.0f} {steps.max():5d}"
    print(f"{text} | {medians[1] / medians[0]:5.2f}", flush=True)


def main() -> None:
    """Print one row a kind of tissue."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tissues", type=int, default=100)
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--means", type=float, nargs="*")
    chosen = parser.parse_args()
    n, n_cells = chosen.tissues, chosen.cells
    means = chosen.means or [3.0, 3.5, 3.7, 3.8, 3.9, 4.0, 4.1, 4.5]
    print(f"{n} tissues of {n_cells} cells each; max_steps=2000")
    columns = f"{'at rest':>7} {'overlap':>7} {'steps':>5} {'most':>5}"
    print(f"{'':>34} | {'without contacts':^27} | {'with':^27} | times")
    print(f"{'':>34} | {columns} | {columns} | as long")
    side = n_cells**0.5
    voronoi = {
        box: [
            vx.initialise.periodic_voronoi(n_cells, key=s, lattice=side * lattice) for s in range(n)
        ]
        for box, lattice in BOXES.items()
    }

    def shapes(seed: int, mean: float, spread: float) -> vx.AbstractEnergy:
        p0 = np.random.default_rng(seed).normal(mean, spread, n_cells)
        return vx.energies.ShapeFactorEnergy(jnp.asarray(p0))

    for spread in (0.0, 0.1):
        for mean in means:
            cases = [(t, shapes(s, mean, spread)) for s, t in enumerate(voronoi["square"])]
            row(f"p0 = {mean}, s.d. {spread}", cases)
    for box in ("sheared", "3 : 1"):
        for mean in (3.8, 4.1):
            cases = [(t, shapes(s, mean, 0.1)) for s, t in enumerate(voronoi[box])]
            row(f"p0 = {mean}, s.d. 0.1, {box} box", cases)

    def tension(tissue: vx.Tissue, seed: int) -> vx.AbstractEnergy:
        gamma = np.random.default_rng(seed).uniform(0.06, 0.6, tissue.n_edges)
        lines = vx.energies.LineTension(jnp.asarray(gamma))
        return vx.energies.AreaElasticity(2.0, 1.0) + lines

    cases = [(t, tension(t, s)) for s, t in enumerate(voronoi["square"])]
    row("line tensions of ratio 10", cases)
    clusters = [vx.initialise.free_voronoi(max(n_cells // 2, 2), key=s) for s in range(n)]
    row("the same, free, half as many cells", [(t, tension(t, s)) for s, t in enumerate(clusters)])


if __name__ == "__main__":
    main()
