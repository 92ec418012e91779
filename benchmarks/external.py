"""Gradients by equilibrium propagation with Surface Evolver, against the implicit gradient of vertax.

The gradient is that of the vertex distance with respect to the tensions of a periodic foam of 20 cells.
Varied are the strength β of the nudge, one-sided and centred, and the tolerance of the program; the last
table compares with finite differences.
"""

from __future__ import annotations

import shutil
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vertax as vx
from vertax.external import AbstractSimulator, External, Relaxed, SurfaceEvolver

jax.config.update("jax_enable_x64", True)

TOLERANCES = (1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
BETAS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)


class Program(AbstractSimulator):
    """Surface Evolver with settings that change between runs without recompilation."""

    def __init__(self) -> None:
        self.evolver = SurfaceEvolver()

    def relax(self, tissue: Any, energy: Any, forces: Any) -> Relaxed:
        """Relax with the present settings."""
        return self.evolver.relax(tissue, energy, forces)


def compared(gradient: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """The relative error of a gradient, and 1 minus its cosine with the expected one."""
    error = np.linalg.norm(gradient - expected) / np.linalg.norm(expected)
    cosine = gradient @ expected / np.linalg.norm(gradient) / np.linalg.norm(expected)
    return float(error), float(1 - cosine)


def main(n_cells: int = 20) -> None:
    """Print three tables."""
    if shutil.which("evolver") is None:
        print("Surface Evolver is not installed: apt-get install evolver-nox", file=sys.stderr)
        return
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(0))
    areas = vx.energies.AreaElasticity(10.0, 1.0)
    energy_of = lambda tensions: areas + vx.energies.LineTension(tensions)
    draw = lambda seed: 0.3 + 0.03 * jax.random.normal(jax.random.key(seed), (tissue.n_edges,))
    target = vx.equilibrate(tissue, energy_of(draw(1))).tissue
    cost = vx.costs.VertexDistance(target)
    tensions = draw(2)
    start = vx.equilibrate(target, energy_of(tensions), transitions=None).tissue
    program = Program()

    def problem(adjoint: vx.adjoints.AbstractAdjoint, response: Any) -> vx.InverseProblem:
        return vx.InverseProblem(
            start, energy_of(tensions), cost, response=response, adjoint=adjoint
        )

    fixed_topology = vx.Relaxation(transitions=None)
    gradient_of = lambda problem: problem.value_and_gradient(throw=False).gradient.terms[1].tension
    implicit = np.asarray(gradient_of(problem(vx.ImplicitDifferentiation(), fixed_topology)))

    @eqx.filter_jit
    def propagated(beta: jax.Array, centred: bool) -> jax.Array:
        adjoint = vx.EquilibriumPropagation(beta, centred=centred, throw=False)
        return gradient_of(problem(adjoint, External(program)))

    external = jax.jit(
        lambda tensions: cost(
            External(program)(start, energy_of(tensions), throw=False).tissue, energy_of(tensions)
        )
    )

    print("relaxed to rounding, by Newton's method")
    print(
        f"{'beta':>8} {'centred: error':>15} {'1 - cosine':>11} {'one-sided: error':>17} {'1 - cosine':>11}"
    )
    for beta in BETAS:
        cells = []
        for centred in (True, False):
            cells += compared(np.asarray(propagated(jnp.array(beta), centred)), implicit)
        print(
            f"{beta:8.0e} {cells[0]:15.1e} {cells[1]:11.1e} {cells[2]:17.1e} {cells[3]:11.1e}",
            flush=True,
        )

    print(
        "\nby conjugate gradients that end when five steps lower the energy by less than this share;"
    )
    print("error of the centred gradient")
    print(f"{'tolerance':>9} " + " ".join(f"{f'beta {beta:.0e}':>10}" for beta in BETAS[2:]))
    for tolerance in TOLERANCES:
        program.evolver = SurfaceEvolver(tolerance=tolerance, newton_steps=0, steps=0)
        errors = [
            compared(np.asarray(propagated(jnp.array(beta), True)), implicit)[0]
            for beta in BETAS[2:]
        ]
        print(f"{tolerance:9.0e} " + " ".join(f"{error:10.1e}" for error in errors), flush=True)

    print("\nthe same program; the best of some strengths of the nudge, and of some steps")
    names = (
        "two nudged runs",
        "2 runs along a direction",
        f"{2 * tensions.size} runs of differences",
    )
    print(
        f"{'tolerance':>9} " + " ".join(f"{name:>27}" for name in names) + "  (error, 1 - cosine)"
    )
    for tolerance in TOLERANCES[::2]:
        program.evolver = SurfaceEvolver(tolerance=tolerance, newton_steps=0, steps=0)
        nudged = [
            compared(np.asarray(propagated(jnp.array(beta), True)), implicit) for beta in BETAS[2:]
        ]
        along, differences = [], []
        for step in (1e-4, 1e-3, 1e-2):
            slope = lambda e, h=step: (
                (external(tensions + h * e) - external(tensions - h * e)) / (2 * h)
            )
            signs = np.sign(np.cos(37.0 * np.arange(1, tensions.size + 1)))
            along.append(compared(float(slope(signs)) * signs, implicit))
            full = np.array([float(slope(e)) for e in np.eye(tensions.size)])
            differences.append(compared(full, implicit))
        cells = [f"{e:.1e}, {c:.1e}" for e, c in map(min, (nudged, along, differences))]
        print(f"{tolerance:9.0e} " + " ".join(f"{cell:>27}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
