"""CPU seconds and peak memory of the tasks of users, each in a new process without a compilation cache.

    python benchmarks/limits.py [--tasks relax_100 gradient_100 ...]

A row has the processor seconds of the imports, of the first call, which compiles, and of the next call on
another tissue of the same size, and the largest memory of the process. Processor seconds are sums over all
threads and, unlike wall time, repeatable beside other processes.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

Task = Callable[[int], Any]


def tasks() -> dict[str, Callable[[], Task]]:
    """Functions by name that prepare a task, which is a function of a seed."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import optax
    from _problems import kicked_problem
    from masks import label_image

    import vertax as vx

    jax.config.update("jax_enable_x64", True)
    friction = vx.dissipations.SubstrateFriction(1.0)

    def system(n: int, seed: int) -> tuple[vx.Tissue, vx.AbstractEnergy]:
        factors = 3.7 + 0.05 * jax.random.normal(jax.random.key(seed), (n,))
        tissue = vx.initialise.periodic_voronoi(n, key=seed, lloyd_steps=2)
        return tissue, vx.energies.ShapeFactorEnergy(factors)

    def relax(n: int) -> Task:
        return lambda seed: vx.equilibrate(*system(n, seed)).tissue

    def relax_free(n: int) -> Task:
        def task(seed: int) -> vx.Tissue:
            cluster = vx.initialise.free_voronoi(n, key=seed, lloyd_steps=2)
            tension = vx.energies.LineTension(jnp.full(cluster.n_edges, 1.0))
            energy = vx.energies.AreaElasticity(20.0, 1.0) + tension
            return vx.equilibrate(*vx.mesh.pad(cluster, energy)).tissue

        return task

    def gradient(n: int) -> Task:
        return lambda seed: kicked_problem(*system(n, seed)).value_and_gradient().cost

    def fit(n: int) -> Task:
        def task(seed: int) -> Any:
            problem = kicked_problem(*system(n, seed))
            return vx.fit(problem, optax.adam(1e-3), 100, progress=False).cost

        return task

    def evolve(n: int) -> Task:
        times = jnp.linspace(0.0, 1.0, 11)
        return lambda seed: vx.evolve(*system(n, seed), friction, times).tissue

    def movie_fit(n: int) -> Task:
        def task(seed: int) -> Any:
            tissue, energy = system(n, seed)
            evolution = vx.Evolution(friction, jnp.linspace(0.0, 1.0, 6))
            frames = evolution(tissue, energy).trajectory[1:]
            cost = vx.costs.Frames([vx.costs.VertexDistance(frame) for frame in frames])
            guess = vx.energies.ShapeFactorEnergy(jnp.full(n, 3.7))
            problem = vx.InverseProblem(tissue, guess, cost, response=evolution)
            return vx.fit(problem, optax.adam(1e-2), 20, progress=False).cost

        return task

    def moduli(n: int) -> Task:
        def task(seed: int) -> Any:
            tissue, energy = system(n, seed)
            relaxed = vx.equilibrate(tissue, energy).tissue
            return vx.mechanics.elastic_tensor(relaxed, energy, throw=False)

        return task

    def masks(n: int) -> list[np.ndarray]:
        side = round(4000 * np.sqrt(n / 5000))
        return [label_image(n, side, np.random.default_rng(seed)) for seed in (0, 1)]

    def from_labels(n: int) -> Task:
        images = masks(n)
        return lambda seed: vx.initialise.from_labels(images[seed], boundary="free")

    def infer_tensions(n: int) -> Task:
        images = masks(n)
        return lambda seed: vx.tensions.infer_tensions(images[seed]).tensions

    sizes: dict[Callable[[int], Task], tuple[int, ...]] = {
        relax: (100, 1000, 10_000),
        relax_free: (100,),
        gradient: (100, 1000),
        fit: (100,),
        evolve: (100, 1000),
        moduli: (100, 1000),
        movie_fit: (20,),
        from_labels: (100, 1000),
        infer_tensions: (100, 1000),
    }
    return {f"{make.__name__}_{n}": partial(make, n) for make, each in sizes.items() for n in each}


def measure(name: str) -> None:
    """Print the row of a task."""
    import jax

    makers, seconds = tasks(), [time.process_time()]
    task = makers[name]()
    for seed in (0, 1):
        start = time.process_time()
        jax.block_until_ready(jax.tree.leaves(task(seed)))
        seconds.append(time.process_time() - start)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    columns = " | ".join(f"{value:.1f}" if value < 10 else f"{value:.0f}" for value in seconds)
    print(f"| {name} | {columns} | {memory:.1f} |", flush=True)


def main() -> None:
    """Measure each task in a new process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", help="names; all by default")
    parser.add_argument("--here", action="store_true", help="in this process")
    options = parser.parse_args()
    if options.here:
        return measure(*options.tasks)
    print("| task | imports | first call | next call | GB |\n|---|---|---|---|---|", flush=True)
    for name in options.tasks or list(tasks()):
        command = [sys.executable, __file__, "--here", "--tasks", name]
        subprocess.run(command, check=False, env=os.environ | {"VERTAX_CACHE": "off"})


if __name__ == "__main__":
    main()
