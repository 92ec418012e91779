"""Nanoseconds per vertex of energy and gradient, and of a Hessian-vector product."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from _timing import first_and_best

import vertax as vx

jax.config.update("jax_enable_x64", True)


@eqx.filter_jit
def gradients(tissue: vx.Tissue, energy: vx.AbstractEnergy, times: int) -> jax.Array:
    """Energy and gradient, `times` times at slightly different positions."""
    f = jax.value_and_grad(lambda x: energy(tissue.with_configuration(x)))
    move = lambda _, x: x - 1e-9 * f(x)[1]
    return jax.lax.fori_loop(0, times, move, tissue.vertices)


@eqx.filter_jit
def products(tissue: vx.Tissue, energy: vx.AbstractEnergy, times: int) -> jax.Array:
    """Hessian-vector products at one configuration."""
    force = jax.grad(lambda x: energy(tissue.with_configuration(x)))
    _, hessian = jax.linearize(force, tissue.vertices)
    return jax.lax.fori_loop(0, times, lambda _, x: 1e-3 * hessian(x), tissue.vertices)


def main() -> None:
    """Print one row for each size."""
    print(f"{'cells':>7} {'voronoi s':>10} {'E + gradient ns/vertex':>23} {'H·v ns/vertex':>14}")
    for n_cells in (100, 1000, 10_000, 100_000):
        make = lambda n=n_cells: vx.initialise.periodic_voronoi(n, key=jax.random.key(0))
        mesh_seconds = first_and_best(make, repeats=1)[1]
        tissue = make()
        energy = vx.energies.ShapeFactorEnergy(jnp.full(n_cells, 3.7))
        times = max(5, 2_000_000 // n_cells // 10)
        cost = [
            first_and_best(f, tissue, energy, jnp.array(times))[1] / times / tissue.n_vertices
            for f in (gradients, products)
        ]
        print(f"{n_cells:7d} {mesh_seconds:10.2f} {cost[0] * 1e9:23.1f} {cost[1] * 1e9:14.1f}")


if __name__ == "__main__":
    main()
