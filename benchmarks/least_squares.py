"""Epochs of Levenberg-Marquardt with a parameter for each cell: by one factorisation, by MINRES, matrix-free.

    python benchmarks/least_squares.py [--cells 100 1000] [--epochs 5] [--solver direct]

The target shape factors of all cells are fitted to the vertices of a tissue. Printed are the seconds of each
epoch, of which the first two compile, and the relative error of the parameters after each. `matrix-free`
never has the Jacobian: conjugate gradients multiply by it and by its transpose, with a linear solve each.
"""

import argparse

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from _arguments import count

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure least squares.")
    parser.add_argument("--cells", type=count, nargs="+", default=[100, 1000])
    parser.add_argument("--epochs", type=count, default=5)
    parser.add_argument("--solver", choices=["direct", "minres", "matrix-free"], default="direct")
    chosen = parser.parse_args()
    solver = vx.solvers.Direct() if chosen.solver == "direct" else vx.MINRES()
    for n_cells in chosen.cells:
        start = vx.initialise.periodic_voronoi(n_cells, key=0, lloyd_steps=2)
        factors = 3.6 + 0.05 * jax.random.normal(jax.random.key(1), (n_cells,))
        truth = vx.energies.ShapeFactorEnergy(factors)
        target = vx.equilibrate(start, truth).tissue
        problem = vx.InverseProblem(
            target,
            vx.energies.ShapeFactorEnergy(jnp.full(n_cells, 3.6)),
            vx.costs.VertexDistance(target),
            adjoint=vx.ImplicitDifferentiation(linear_solver=solver),
        )
        products = lx.Normal(lx.CG(rtol=1e-3, atol=1e-12))
        inner = products if chosen.solver == "matrix-free" else lx.QR()
        method = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8, linear_solver=inner)
        history = vx.fit(problem, method, chosen.epochs, truth=truth, progress=False).history
        print(f"{n_cells} cells, seconds: {np.round(history.seconds, 2)}", flush=True)
        print("  relative error:", *(f"{error:.0e}" for error in history.relative_error))


if __name__ == "__main__":
    main()
