"""Milliseconds per epoch of an inference (relaxation, gradient, update), and its compile time."""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main(sizes: tuple[int, ...] = (20, 100, 1000), epochs: int = 60) -> None:
    """Print one row a size."""
    print(
        f"{'cells':>6} {'first epoch s':>14} {'ms/epoch':>9} {'Newton steps':>13} {'T1s':>4} "
        f"{'relative error':>24}"
    )
    for n in sizes:
        tissue = vx.initialise.periodic_voronoi(n, key=jax.random.key(0))
        p0 = 3.7 + 0.1 * jax.random.normal(jax.random.key(1), (n,))
        truth = vx.energies.ShapeFactorEnergy(p0)
        target = vx.equilibrate(tissue, truth).tissue
        problem = vx.InverseProblem(
            tissue=target,
            energy=vx.energies.ShapeFactorEnergy(jnp.full(n, 3.7)),
            cost=vx.costs.VertexDistance(target),
            adjoint=vx.ImplicitDifferentiation(),
        )
        fit = vx.fit(problem, optax.adam(1e-2), epochs, truth=truth, progress=False)
        h = fit.history
        print(
            f"{n:6d} {h.seconds[0]:14.1f} {1e3 * np.median(h.seconds[1:]):9.2f} "
            f"{h.num_steps[1:].mean():13.1f} {h.num_t1.sum():4d} "
            f"{h.relative_error[0]:11.2e} -> {h.relative_error[-1]:8.2e}"
        )


if __name__ == "__main__":
    main(tuple(int(x) for x in sys.argv[1:]) or (20, 100, 1000))
