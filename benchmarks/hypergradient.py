"""Relative error of the hypergradient of the vertex distance, against two references."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main(sizes: tuple[int, ...] = (20, 64)) -> None:
    """Print one row a size."""
    print(f"{'cells':>6} {'dense pseudo-inverse':>21} {'finite differences':>19}")
    for n in sizes:
        draw = lambda seed, n=n: 3.7 + 0.1 * jax.random.normal(jax.random.key(seed), (n,))
        tissue = vx.initialise.periodic_voronoi(n, key=jax.random.key(0))
        energy_of = vx.energies.ShapeFactorEnergy
        cost = vx.costs.VertexDistance(vx.equilibrate(tissue, energy_of(draw(1))).tissue)
        p0 = draw(2)
        start = vx.equilibrate(cost.target, energy_of(p0)).tissue

        def relaxed(p: jax.Array, start: vx.Tissue = start) -> vx.Tissue:
            options = {"tolerance": 1e-13, "transitions": None, "throw": False}
            return vx.equilibrate(start, energy_of(p), **options).tissue

        loss = jax.jit(lambda p, cost=cost, relaxed=relaxed: cost(relaxed(p), energy_of(p)))
        gradient = jax.jit(jax.grad(loss))(p0)

        at = relaxed(p0)
        flat = at.vertices.ravel()
        energy = lambda x, p, at=at: energy_of(p)(at.with_configuration(x.reshape(-1, 2)))
        hessian = jax.hessian(energy)(flat, p0)
        mixed = jax.jacobian(jax.grad(energy), argnums=1)(flat, p0)
        pull = jax.grad(lambda x, at=at, c=cost: c(at.with_configuration(x), energy_of(p0)))(
            at.vertices
        )
        dense = -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ pull.ravel()

        step = 1e-5
        unit = jnp.eye(n) * step
        central = jnp.stack([(loss(p0 + e) - loss(p0 - e)) / (2 * step) for e in unit])
        error = lambda reference, g=gradient: float(
            jnp.linalg.norm(g - reference) / jnp.linalg.norm(reference)
        )
        print(f"{n:6d} {error(dense):21.1e} {error(central):19.1e}")


if __name__ == "__main__":
    main()
