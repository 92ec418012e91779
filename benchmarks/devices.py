"""Relaxations, gradients, batches, image costs and time steps on the device that JAX selects.

    python benchmarks/devices.py [--precision float32] [--parts relaxation ...] [--cells 100 ...]

Each row has the seconds of compilation and those of the fastest of three later calls. `JAX_PLATFORMS=cpu`
measures the CPU of the same machine.

- relaxation: of a random tissue of `--cells` cells with target shape factors 3.7 ± 0.1;
- gradient: of a distance of vertices with respect to all target shape factors, at this equilibrium;
- batch: relaxations of 1000 random tissues of 64 cells by one `jax.vmap`;
- image: cost of an image and its gradient, at 10 to 33 pixels per cell size;
- evolution: 20 steps of `evolve` with friction, from a random tissue, and its gradient.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from _arguments import count
from _problems import kicked_problem
from _timing import first_and_best

import vertax as vx


def row(
    part: str,
    n_cells: int,
    function: Callable[..., Any],
    *args: Any,
    note: Callable[[Any], str] | None = None,
) -> None:
    """Measure a function and print a row, with a note on its result (which takes one more call)."""
    first, best = first_and_best(function, *args, repeats=3)
    precision = jnp.result_type(float).name
    comment = "" if note is None else note(function(*args))
    times = f"{first - best:10.1f} {best:12.5f}"
    print(f"{part:>12} {n_cells:8d} {precision:>8} {times}  {comment}", flush=True)


def random_tissue(n_cells: int, seed: int = 0) -> tuple[vx.Tissue, vx.AbstractEnergy]:
    """A random tissue and its energy."""
    noise = jax.random.normal(jax.random.key(1000 + seed), (n_cells,))
    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(seed))
    return tissue, vx.energies.ShapeFactorEnergy(3.7 + 0.1 * noise)


@eqx.filter_jit
def relaxed(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> vx.Equilibrium:
    """A relaxation."""
    return vx.equilibrate(tissue, energy, throw=False)


def state(end: vx.Equilibrium) -> str:
    """How a relaxation ended."""
    force = f"at rest at {float(end.max_force):.0e}" if end.converged else str(end.result)
    return f"{int(end.num_steps)} steps, {int(end.num_t1)} T1s, {force}"


def relaxation(sizes: list[int]) -> None:
    """Relaxations."""
    for n_cells in sizes:
        row("relaxation", n_cells, relaxed, *random_tissue(n_cells), note=state)


def gradient(sizes: list[int]) -> None:
    """Gradients at an equilibrium."""
    for n_cells in sizes:
        tissue, energy = random_tissue(n_cells)
        problem = kicked_problem(relaxed(tissue, energy).tissue, energy)
        evaluate = eqx.filter_jit(lambda problem: problem.value_and_gradient(throw=False))
        note = lambda value: f"{int(value.outcome.num_steps)} iterations of MINRES"
        row("gradient", n_cells, evaluate, problem, note=note)


def batch(sizes: list[int], n_tissues: int = 1000, n_cells: int = 64) -> None:
    """One batch of relaxations, and the same number of calls."""
    tissues, energies = zip(
        *(random_tissue(n_cells, seed) for seed in range(n_tissues)), strict=True
    )
    arrays, static = zip(*(eqx.partition(t, eqx.is_array) for t in tissues), strict=True)
    stack = lambda members: jax.tree.map(lambda *x: jnp.stack(x), *members)

    def energy_at_rest(one, energy):
        return relaxed(eqx.combine(one, static[0]), energy).energy

    row("batch", n_cells, jax.jit(jax.vmap(energy_at_rest)), stack(arrays), stack(energies))
    row("one of them", n_cells, jax.jit(energy_at_rest), arrays[0], energies[0])


def image(sizes: list[int]) -> None:
    """Image costs and their gradients."""
    for n_cells, side in ((20, 128), (100, 256), (1000, 1024)):
        tissue, energy = random_tissue(n_cells)
        width = 2 * n_cells**0.5 / side
        cost = vx.costs.MeshImage(vx.costs.render(tissue, (side, side), width), width)
        value = lambda x, t=tissue, e=energy, c=cost: c(t.with_vertices(x), e)
        evaluate = eqx.filter_jit(jax.value_and_grad(value))
        row(
            "image",
            n_cells,
            evaluate,
            tissue.vertices + 0.01,
            note=lambda _, n=side: f"{n} × {n} pixels",
        )


def evolution(sizes: list[int], n_steps: int = 20) -> None:
    """Movements in time and their gradients."""
    times = jnp.linspace(0, 5, n_steps + 1)
    for n_cells in [n for n in sizes if n <= 100_000]:
        tissue, energy = random_tissue(n_cells)

        def cost(energy, tissue=tissue):
            friction = vx.dissipations.SubstrateFriction(1.0)
            movie = vx.evolve(tissue, energy, friction, times, throw=False)
            return jnp.sum(movie.tissue.perimeters**2)

        row("evolution", n_cells, eqx.filter_jit(cost), energy, note=lambda _: f"{n_steps} steps")
        row("and gradient", n_cells, eqx.filter_jit(eqx.filter_grad(cost)), energy)


PARTS = {f.__name__: f for f in (relaxation, gradient, batch, image, evolution)}


def main() -> None:
    """Print a row for each part and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--precision", choices=["float64", "float32"], default="float64")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--cells", type=count, nargs="+", default=[100, 1000])
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", chosen.precision == "float64")
    print(f"{jax.devices()[0].device_kind}, JAX {jax.__version__}")
    print(f"{'part':>12} {'cells':>8} {'':>8} {'compile, s':>10} {'run, s':>12}")
    for part in chosen.parts:
        PARTS[part](chosen.cells)


if __name__ == "__main__":
    main()
