"""Fraction of random tissues that reach equilibrium; force, steps, transitions, seconds."""

from __future__ import annotations

import time

import equinox as eqx
import jax
import numpy as np

import vertax as vx

jax.config.update("jax_enable_x64", True)


@eqx.filter_jit
def relax(tissue: vx.Tissue, p0: jax.Array) -> vx.Equilibrium:
    """Default relaxation to forces below 1e-8."""
    energy = vx.energies.ShapeFactorEnergy(p0)
    return vx.equilibrate(tissue, energy, tolerance=1e-8, throw=False)


def main(n_tissues: int = 100, n_cells: int = 64) -> None:
    """Print one row for each mean target shape factor."""
    print(f"{n_tissues} random Voronoi tissues of {n_cells} cells, s.d. of p0 0.1, force < 1e-8")
    print(f"{'mean p0':>8} {'share':>6} {'steps':>12} {'T1s':>6} {'ms':>15} {'largest force':>14}")
    tissues = [
        vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(s)) for s in range(n_tissues)
    ]
    for mean in (3.5, 3.7, 3.8, 3.9):
        rows = []
        for seed, tissue in enumerate(tissues):
            p0 = mean + 0.1 * jax.random.normal(jax.random.key(1000 + seed), (n_cells,))
            relax(tissue, p0)
            began = time.perf_counter()
            end = jax.block_until_ready(relax(tissue, p0))
            seconds = time.perf_counter() - began
            rows.append((end.converged, end.num_steps, end.num_t1, seconds, end.max_force))
        converged, steps, t1s, seconds, force = np.array(rows, float).T
        print(
            f"{mean:8.2f} {converged.mean():6.2f} {np.median(steps):5.0f} ≤{steps.max():5.0f} "
            f"{t1s.mean():6.1f} {1e3 * np.median(seconds):6.1f} ≤{1e3 * seconds.max():7.1f} "
            f"{force.max():14.1e}"
        )


if __name__ == "__main__":
    main()
