"""Milliseconds of the image cost and its gradient."""

from __future__ import annotations

import equinox as eqx
import jax
from _timing import first_and_best

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Print one row for each size."""
    print(f"{'cells':>6} {'pixels':>12} {'cost + gradient ms':>19}")
    for n, side in ((20, 128), (100, 256), (1000, 1024)):
        tissue = vx.initialise.periodic_voronoi(n, key=jax.random.key(0), lloyd_steps=2)
        width = 2 * n**0.5 / side
        image = vx.costs.render(tissue, (side, side), width)
        cost = vx.costs.MeshImage(image, width)
        energy = vx.energies.ShapeFactorEnergy(3.7)
        evaluate = eqx.filter_jit(
            jax.value_and_grad(lambda x, t=tissue, c=cost, e=energy: c(t.with_configuration(x), e))
        )
        best = first_and_best(evaluate, tissue.vertices + 0.01)[1]
        print(f"{n:6d} {side:5d} × {side:4d} {1e3 * best:19.1f}")


if __name__ == "__main__":
    main()
