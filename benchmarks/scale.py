"""Scaling of relaxations and gradients with the number of cells, with the coarse preconditioner and without.

Of relaxations from random tissues to forces below 1e-8: mean and largest number of steps, T1s, products
with the Hessian, and seconds (without compilation); and steps and seconds of a gradient at the first
equilibrium. Each cell has a random target shape factor, of s.d. 0.1, or, for the kind `tensions`, each
edge a random line tension of ratio 3. (Average over several tissues: the path of a single large one
depends on rounding errors.)
"""

from __future__ import annotations

import argparse
import time

import equinox as eqx
import jax
import numpy as np
from _arguments import count
from _problems import kicked_problem
from _timing import first_and_best

import vertax as vx
import vertax.relax._objective as objective_module
from vertax.precondition._elastic_medium import ElasticMedium

jax.config.update("jax_enable_x64", True)
FEWEST = ElasticMedium.min_cells
FEWEST_FOR_EDGES = objective_module.MIN_CELLS_OF_EDGE_BLOCKS
TOLERANCE = 1e-8


def energy_of(kind: str, tissue: vx.Tissue, seed: int = 0) -> vx.AbstractEnergy:
    """Target shape factors with the mean `kind`, or line tensions if it is `tensions`."""
    key = jax.random.key(1 + seed)
    if kind == "tensions":
        gamma = jax.random.uniform(key, (tissue.n_edges,), minval=0.2, maxval=0.6)
        return vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.LineTension(gamma)
    factors = float(kind) + 0.1 * jax.random.normal(key, (tissue.n_cells,))
    return vx.energies.ShapeFactorEnergy(factors)


def row(n_cells: int, kind: str, fewest: int, tissues: int, repeats: int) -> str:
    """Results with the coarse preconditioner used from `fewest` cells on."""
    ElasticMedium.min_cells = fewest
    objective_module.MIN_CELLS_OF_EDGE_BLOCKS = max(fewest, FEWEST_FOR_EDGES)
    jax.clear_caches()

    @eqx.filter_jit
    def relax(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> tuple:
        search = vx.Relaxation(tolerance=TOLERANCE).search(tissue, energy)
        end = search.advance(search.begin(tissue, energy), energy, 2000)
        counts = end.num_steps, end.num_t1, end.iteration.num_products
        return end.tissue, counts

    def tissue_and_energy(seed: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
        tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(seed))
        return tissue, energy_of(kind, tissue, seed)

    def timed(seed: int) -> tuple[vx.Tissue, tuple]:
        given = tissue_and_energy(seed)
        began = time.perf_counter()
        relaxed, counts = relax(*given)
        counts = tuple(map(int, counts))
        return relaxed, (*counts, time.perf_counter() - began)

    with_compilation = timed(0)[1][-1]
    relaxed, rows = zip(*map(timed, range(tissues)), strict=True)
    steps, t1s, products, seconds = np.array(rows).T

    (_, energy), first = tissue_and_energy(0), relaxed[0]
    problem = kicked_problem(first, energy, response=vx.Relaxation(tolerance=TOLERANCE))
    gradient = eqx.filter_jit(lambda problem: problem.value_and_gradient(throw=False))
    _, gradient_seconds = first_and_best(gradient, problem, repeats=repeats)
    linear = gradient(problem).outcome.num_steps
    return (
        f"{n_cells:7d} {kind:>8} {'with' if fewest <= n_cells else 'without':>8} {steps.mean():7.1f} "
        f"{steps.max():5.0f} {t1s.mean():8.1f} {products.mean():9.0f} {seconds.mean():8.2f} "
        f"{int(linear):7d} {gradient_seconds:9.3f} {with_compilation - seconds[0]:10.1f}"
    )


def main() -> None:
    """Print a row for each size, kind and choice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=count, nargs="*", default=[100, 400, 1000])
    parser.add_argument("--kinds", nargs="*", default=["3.7", "3.9", "tensions"])
    parser.add_argument("--waves", choices=["with", "without", "both"], default="both")
    parser.add_argument("--tissues", type=count, default=4)
    parser.add_argument("--repeats", type=count, default=3)
    chosen = parser.parse_args()
    print(
        f"{'cells':>7} {'kind':>8} {'waves':>8} {'steps':>7} {'most':>5} {'T1s':>8} {'products':>9} "
        f"{'seconds':>8} {'linear':>7} {'gradient':>9} {'compiling':>10}"
    )
    for kind in chosen.kinds:
        for n_cells in chosen.cells:
            small = n_cells < FEWEST
            if chosen.waves != "with" or small:
                print(row(n_cells, kind, n_cells + 1, chosen.tissues, chosen.repeats), flush=True)
            if chosen.waves != "without" and not small:
                print(row(n_cells, kind, FEWEST, chosen.tissues, chosen.repeats), flush=True)


if __name__ == "__main__":
    main()
