"""Compile time of the parts of an epoch: seconds of tracing, of lowering to StableHLO and of XLA.

Each part is compiled separately, without a cache. Kernels are the fusions of the compiled program.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from _arguments import count

import vertax as vx

jax.config.update("jax_enable_x64", True)


def force(vertices: jax.Array, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
    """The gradient of the energy."""
    return jax.grad(lambda x: energy(tissue.with_vertices(x)))(vertices)


def product(vertices: jax.Array, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
    """A product with the Hessian."""
    return jax.jvp(lambda x: force(x, tissue, energy), (vertices,), (vertices,))[1]


def transitions(vertices: jax.Array, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
    """A sweep of T1 transitions."""
    rule = vx.T1()
    return rule.sweep(tissue.with_vertices(vertices), energy, rule.init(tissue))[0].vertices


def _relaxation(**options: Any) -> Callable[..., jax.Array]:
    def relaxed(vertices: jax.Array, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
        start = tissue.with_vertices(vertices)
        return vx.equilibrate(start, energy, throw=False, **options).tissue.vertices

    return relaxed


def _gradient(**options: Any) -> Callable[..., jax.Array]:
    relaxed = _relaxation(**options)

    def gradient(vertices: jax.Array, tissue: vx.Tissue, energy: vx.AbstractEnergy) -> jax.Array:
        cost = lambda energy: jnp.sum(relaxed(vertices, tissue, energy) ** 2)
        return jax.grad(cost)(energy).target_shape_factor

    return gradient


PARTS = {
    "force": force,
    "Hessian product": product,
    "T1 sweep": transitions,
    "relaxation, bare": _relaxation(contact_range=None, transitions=None),
    "relaxation": _relaxation(),
    "and gradient, bare": _gradient(contact_range=None, transitions=None),
    "and gradient": _gradient(),
}
"""Parts of an epoch; bare: without contacts and transitions."""


def main() -> None:
    """Print a row for each part and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=count, nargs="*", default=[100, 400])
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=list(PARTS))
    chosen = parser.parse_args()
    print(f"{'part':>20} {'cells':>6} {'trace':>7} {'lower':>7} {'XLA':>7} {'kernels':>8}")
    for n_cells in chosen.cells:
        tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(0))
        energy = vx.energies.ShapeFactorEnergy(jnp.full(n_cells, 3.7))
        for part in chosen.parts:
            jax.clear_caches()
            times = [time.perf_counter()]
            traced = jax.jit(PARTS[part]).trace(tissue.vertices, tissue, energy)
            times.append(time.perf_counter())
            lowered = traced.lower()
            times.append(time.perf_counter())
            program = lowered.compile()
            times.append(time.perf_counter())
            trace, lower, xla = (b - a for a, b in pairwise(times))
            kernels = (program.as_text() or "").count(" fusion(")
            print(
                f"{part:>20} {n_cells:6d} {trace:7.2f} {lower:7.2f} {xla:7.2f} {kernels:8d}",
                flush=True,
            )


if __name__ == "__main__":
    main()
