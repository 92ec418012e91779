"""Relative error of the hypergradient of the vertex distance, against two references."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import vertax as vx

jax.config.update("jax_enable_x64", True)


def errors(n_cells: int) -> tuple[float, float]:
    """Error against a dense pseudo-inverse, and against central differences of the cost."""
    energy_of = vx.energies.ShapeFactorEnergy
    draw = lambda seed: 3.7 + 0.1 * jax.random.normal(jax.random.key(seed), (n_cells,))
    p0 = draw(2)
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(0))
    target = vx.equilibrate(tissue, energy_of(draw(1))).tissue
    start = vx.equilibrate(target, energy_of(p0)).tissue
    cost = vx.costs.VertexDistance(target)

    def relaxed(p: jax.Array) -> vx.Tissue:
        options = {"tolerance": 1e-13, "transitions": None, "throw": False}
        return vx.equilibrate(start, energy_of(p), **options).tissue

    loss = jax.jit(lambda p: cost(relaxed(p), energy_of(p)))
    gradient = jax.jit(jax.grad(loss))(p0)

    at = relaxed(p0)
    flat = at.vertices.ravel()
    energy = lambda x, p: energy_of(p)(at.with_configuration(x.reshape(-1, 2)))
    hessian = jax.hessian(energy)(flat, p0)
    mixed = jax.jacobian(jax.grad(energy), argnums=1)(flat, p0)
    misfit = lambda x: cost(at.with_configuration(x.reshape(-1, 2)), energy_of(p0))
    dense = -mixed.T @ np.linalg.pinv(hessian, rcond=1e-10) @ jax.grad(misfit)(flat)

    step = 1e-5
    ahead_behind = [(loss(p0 + e), loss(p0 - e)) for e in step * jnp.eye(n_cells)]
    central = jnp.stack([(ahead - behind) / (2 * step) for ahead, behind in ahead_behind])
    error = lambda reference: float(
        jnp.linalg.norm(gradient - reference) / jnp.linalg.norm(reference)
    )
    return error(dense), error(central)


def main() -> None:
    """Print one row for each size."""
    print(f"{'cells':>6} {'dense pseudo-inverse':>21} {'finite differences':>19}")
    for n_cells in (20, 64):
        dense, central = errors(n_cells)
        print(f"{n_cells:6d} {dense:21.1e} {central:19.1e}")


if __name__ == "__main__":
    main()
