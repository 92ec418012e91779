"""How relaxations and gradients grow with the tissue, with the long waves of large tissues and without.

Steps and T1s of a relaxation from a random tissue to forces below 1e-8, products with its Hessian, steps of
the linear solver behind a gradient there, and seconds (without compilation). A tissue has a random
target shape factor in each cell, of s.d. 0.1, or, where `tensions` is asked for, line tensions of ratio 3.
"""

from __future__ import annotations

import argparse

import equinox as eqx
import jax
from _timing import first_and_best

import vertax as vx
import vertax.solvers._long_waves as long_waves

jax.config.update("jax_enable_x64", True)
FEWEST = long_waves.FEWEST_CELLS
TOLERANCE = 1e-8


def energy_of(kind: str, tissue: vx.Tissue) -> vx.AbstractEnergy:
    """Target shape factors about a number, or `tensions`."""
    key = jax.random.key(1)
    if kind == "tensions":
        gamma = jax.random.uniform(key, (tissue.n_edges,), minval=0.2, maxval=0.6)
        return vx.energies.AreaElasticity(2.0, 1.0) + vx.energies.LineTension(gamma)
    factors = float(kind) + 0.1 * jax.random.normal(key, (tissue.n_cells,))
    return vx.energies.ShapeFactorEnergy(factors)


def row(n_cells: int, kind: str, fewest: int, repeats: int) -> str:
    """What a relaxation and a gradient take if tissues from this number of cells on have long waves."""
    long_waves.FEWEST_CELLS = fewest
    jax.clear_caches()
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(0))
    energy = energy_of(kind, tissue)

    @eqx.filter_jit
    def relax(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> tuple:
        search = vx.Relaxation(tolerance=TOLERANCE).search(tissue, energy)
        end = search.advance(search.begin(tissue, energy), energy, 2000)
        return end.tissue, end.num_steps, end.num_t1, end.minimiser.inner.num_products

    compiled, seconds = first_and_best(relax, tissue, energy, repeats=repeats)
    relaxed, steps, t1s, products = relax(tissue, energy)
    kicks = 0.01 * jax.random.normal(jax.random.key(2), relaxed.vertices.shape)
    problem = vx.InverseProblem(
        tissue=relaxed,
        energy=energy,
        cost=vx.costs.VertexDistance(relaxed.with_vertices(relaxed.vertices + kicks)),
        response=vx.Relaxation(tolerance=TOLERANCE),
        adjoint=vx.ImplicitDifferentiation(throw=False),
    )
    gradient = eqx.filter_jit(lambda problem: problem.value_and_gradient(throw=False))
    _, gradient_seconds = first_and_best(gradient, problem, repeats=repeats)
    linear = gradient(problem).outcome.num_steps
    return (
        f"{n_cells:7d} {kind:>8} {'with' if fewest <= n_cells else 'without':>8} {int(steps):6d} "
        f"{int(t1s):6d} {int(products):9d} {seconds:9.2f} {int(linear):7d} {gradient_seconds:9.3f} "
        f"{compiled - seconds:9.1f}"
    )


def main() -> None:
    """Print a row for each size, kind and choice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs="*", default=[100, 400, 1000])
    parser.add_argument("--kinds", nargs="*", default=["3.7", "3.9", "tensions"])
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args()
    print(
        f"{'cells':>7} {'kind':>8} {'waves':>8} {'steps':>6} {'T1s':>6} {'products':>9} {'seconds':>9} "
        f"{'linear':>7} {'gradient':>9} {'compiling':>9}"
    )
    for kind in chosen.kinds:
        for n_cells in chosen.cells:
            for fewest in (n_cells + 1, FEWEST):
                if fewest == FEWEST and n_cells < FEWEST:
                    continue
                print(row(n_cells, kind, fewest, chosen.repeats), flush=True)


if __name__ == "__main__":
    main()
