"""Milliseconds per epoch of an inference (relaxation, gradient, update), and its compile time.

Fits of small tissues reuse a Hessian from epoch `FIRST_LOOK` on, which shortens the epochs. Printed are
the median of the epochs before and the mean of those after (without the epoch that compiles this), and the
ratio of the time of an epoch with contacts to that without, from several fits of both kinds in turn.
"""

from __future__ import annotations

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
from _arguments import count

import vertax as vx
from vertax.fitting._descent import _FIRST_HESSIAN_EPOCH as FIRST_LOOK

jax.config.update("jax_enable_x64", True)
# One object, so that fits share what is compiled.
OPTIMISER = optax.adam(1e-2)
ADJOINTS = {
    "implicit": vx.ImplicitDifferentiation(),
    "propagation": vx.EquilibriumPropagation(),
}


def run(problem: vx.InverseProblem, truth: vx.AbstractEnergy, epochs: int) -> vx.fitting.History:
    """The history of a fit."""
    return vx.fit(problem, OPTIMISER, epochs, truth=truth, progress=False).history


def epochs_of(history: vx.fitting.History) -> tuple[float, float]:
    """Milliseconds of an epoch before and after the Hessian is reused."""
    seconds = 1e3 * history.seconds
    return float(np.median(seconds[1:FIRST_LOOK])), float(np.mean(seconds[FIRST_LOOK + 1 :]))


def main() -> None:
    """Print one row for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", type=count, nargs="*", default=[20, 100, 1000])
    parser.add_argument("--adjoint", choices=list(ADJOINTS), default="implicit")
    parser.add_argument("--epochs", type=count, default=2 * FIRST_LOOK)
    chosen = parser.parse_args()
    if chosen.epochs < FIRST_LOOK + 2:
        parser.error(
            f"argument --epochs: must be at least {FIRST_LOOK + 2}, but is {chosen.epochs}"
        )
    print(
        f"{'cells':>6} {'first epoch s':>14} {'ms/epoch':>9} {'later':>9} {'Newton steps':>13} {'T1s':>4} "
        f"{'relative error':>24} {'over without contacts':>22}"
    )
    for n in chosen.cells:
        tissue = vx.initialise.periodic_voronoi(n, key=jax.random.key(0))
        p0 = 3.7 + 0.1 * jax.random.normal(jax.random.key(1), (n,))
        truth = vx.energies.ShapeFactorEnergy(p0)
        target = vx.equilibrate(tissue, truth).tissue
        problem = vx.InverseProblem(
            tissue=target,
            energy=vx.energies.ShapeFactorEnergy(jnp.full(n, 3.7)),
            cost=vx.costs.VertexDistance(target),
            adjoint=ADJOINTS[chosen.adjoint],
        )
        free = dataclasses.replace(problem, response=vx.Relaxation(contact_range=None))
        pairs = [
            (run(problem, truth, chosen.epochs), run(free, truth, chosen.epochs)) for _ in range(3)
        ]
        ratio = np.median([epochs_of(a)[1] / epochs_of(b)[1] for a, b in pairs])
        at_first, later = np.median(
            [epochs_of(with_contacts) for with_contacts, _ in pairs], axis=0
        )
        h = pairs[0][0]
        print(
            f"{n:6d} {h.seconds[0]:14.1f} {at_first:9.2f} {later:9.2f} "
            f"{h.num_steps[1:].mean():13.1f} {h.num_t1.sum():4d} "
            f"{h.relative_error[0]:11.2e} -> {h.relative_error[-1]:8.2e} {ratio:22.2f}"
        )


if __name__ == "__main__":
    main()
