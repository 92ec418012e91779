"""Seconds from the start of a process to the first results, with and without a compilation cache.

Each row is a step of one process, in this order; the first column of seconds is without a cache of
compiled functions, the second with the cache of an earlier process. `programs` is the number of programs
that XLA compiles in the step without a cache; most are small. `--masks` adds tensions of 20 masks of 90 to
110 cells.

To compare with another version run this file with the Python of an environment that has that version.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

from _arguments import count

N_BATCH, CELLS_OF_BATCH, N_REPEATS = 60, 20, 10


def steps(n_cells: int) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The steps of a session, in order."""
    import jax
    import jax.numpy as jnp
    import optax

    import vertax as vx

    tissue = vx.initialise.periodic_voronoi(n_cells, key=jax.random.key(0))
    energy = lambda factor: vx.energies.ShapeFactorEnergy(jnp.full(n_cells, factor))
    state: dict[str, Any] = {}

    def equilibrate(factor: float) -> None:
        state["target"] = vx.equilibrate(tissue, energy(factor)).tissue
        jax.block_until_ready(state["target"].vertices)

    def problem() -> vx.InverseProblem:
        cost = vx.costs.VertexDistance(state["target"])
        return vx.InverseProblem(state["target"], energy(3.68), cost)

    yield "first equilibrate", lambda: equilibrate(3.65)
    yield "second, other numbers", lambda: equilibrate(3.7)
    yield (
        "first value_and_gradient",
        lambda: jax.block_until_ready(problem().value_and_gradient().cost),
    )
    fit = lambda: vx.fit(problem(), optax.adam(1e-2), 2, progress=False)
    yield "first fit, 2 epochs", fit
    yield "second, new optimiser", fit
    friction = vx.dissipations.SubstrateFriction(1.0)
    times = jnp.linspace(0, 1, 3)
    yield "first evolve", lambda: vx.evolve(tissue, energy(3.7), friction, times).tissue.vertices


def batch_steps() -> Iterator[tuple[str, Callable[[], Any]]]:
    """A batch of tissues, one by one and by `jax.vmap`."""
    import jax
    import jax.numpy as jnp

    import vertax as vx

    energy = vx.energies.ShapeFactorEnergy(jnp.full(CELLS_OF_BATCH, 3.7))
    keys = jax.random.split(jax.random.key(0), N_BATCH)
    tissues = [vx.initialise.periodic_voronoi(CELLS_OF_BATCH, key=key) for key in keys]
    batch = vx.fitting.stack(tissues)
    relaxed = jax.jit(lambda tissue: vx.equilibrate(tissue, energy, throw=False).energy)
    mapped = jax.jit(jax.vmap(relaxed))
    cost = vx.costs.VertexDistance(tissues[0])

    def loss(factors: jax.Array, tissue: vx.Tissue) -> jax.Array:
        end = vx.equilibrate(tissue, vx.energies.ShapeFactorEnergy(factors), throw=False)
        return cost(end.tissue, energy)

    slope = jax.jit(jax.grad(loss))
    slopes = jax.jit(jax.vmap(jax.grad(loss), in_axes=(None, 0)))
    factors = energy.target_shape_factor
    pairs = {
        "relaxations": (lambda: [relaxed(t) for t in tissues], lambda: mapped(batch)),
        "gradients": (
            lambda: [slope(factors, t) for t in tissues],
            lambda: slopes(factors, batch),
        ),
    }
    for what, (one_by_one, together) in pairs.items():
        for name, run in ((f"{N_BATCH} {what}, a loop", one_by_one), ("by jax.vmap", together)):
            wait = lambda run=run: jax.block_until_ready(run())
            yield f"{name}: first", wait
            yield f"{name}: {N_REPEATS} more", lambda wait=wait: [wait() for _ in range(N_REPEATS)]


def mask_steps() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Tensions of 20 masks of 90 to 110 cells."""
    import numpy as np
    from scipy.spatial import KDTree

    import vertax as vx

    def mask(n_cells: int, seed: int, size: int = 500) -> np.ndarray:
        rng = np.random.default_rng(seed)
        middle = 0.5 * size
        place = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) + 0.5
        inside = np.hypot(*(place - middle).T) < 0.42 * size
        seeds = place[rng.choice(np.flatnonzero(inside), n_cells, replace=False)]
        nearest_seed = lambda: np.asarray(KDTree(seeds).query(place)[1])
        for _ in range(5):  # Lloyd
            nearest = nearest_seed()[inside]
            sums = [np.bincount(nearest, x, n_cells) for x in place[inside].T]
            weights = np.bincount(nearest, minlength=n_cells)
            seeds = np.stack(sums, axis=1) / np.maximum(weights, 1)[:, None]
        return np.where(inside, nearest_seed() + 1, 0).reshape(size, size)

    masks = [mask(int(n), seed) for seed, n in enumerate(np.linspace(90, 110, 20))]
    for number, image in enumerate(masks):
        yield f"mask {number}", lambda image=image: vx.tensions.infer_tensions(image)


def session(kind: str) -> None:
    """Print each step of one process, its seconds, and the number of programs compiled."""
    began = time.perf_counter()
    import jax

    jax.config.update("jax_enable_x64", True)
    import vertax as vx

    vx.equilibrate  # noqa: B018  imports the package, which is lazy
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration_secs, **_: compiled.append(event)
    )
    print(json.dumps(["import", time.perf_counter() - began, 0]), flush=True)
    chosen = {"batch": batch_steps, "masks": mask_steps}
    for name, run in chosen[kind]() if kind in chosen else steps(int(kind)):
        compiled.clear()
        began = time.perf_counter()
        run()
        seconds = time.perf_counter() - began
        programs = compiled.count("/jax/core/compile/backend_compile_duration")
        print(json.dumps([name, seconds, programs]), flush=True)


def measured(kind: str, folder: str | None) -> list[tuple[str, float, int]]:
    """Run the steps in a new process; return their names, seconds and numbers of programs."""
    environment = os.environ | {"PYTHONWARNINGS": "ignore", "VERTAX_CACHE": "off"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    if folder is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
        }
    command = [sys.executable, __file__, "--session", kind]
    out = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return [tuple(json.loads(line)) for line in out.stdout.splitlines()]  # pyright: ignore[reportReturnType]


def main() -> None:
    """Print a table for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=count, nargs="*", default=[20, 100, 400])
    parser.add_argument("--no-batch", action="store_true", help="leave out the batch")
    parser.add_argument("--masks", action="store_true", help="tensions of 20 masks too")
    parser.add_argument("--no-cache", action="store_true", help="leave out the second column")
    parser.add_argument("--session", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.session is not None:
        session(chosen.session)
        return
    kinds = [str(n) for n in chosen.cells]
    kinds += [] if chosen.no_batch else ["batch"]
    kinds += ["masks"] if chosen.masks else []
    for kind in kinds:
        print(
            f"{f'{kind} cells' if kind.isdigit() else kind:>32} {'no cache':>9} {'cache':>9} {'programs':>9}"
        )
        with tempfile.TemporaryDirectory() as folder:
            rows = measured(kind, None if chosen.no_cache else folder)
            again = rows if chosen.no_cache else measured(kind, folder)
        for (name, first, programs), (_, second, _) in zip(rows, again, strict=True):
            cached = "" if chosen.no_cache else f"{second:9.2f}"
            print(f"{name:>32} {first:9.2f} {cached:>9} {programs:9d}", flush=True)


if __name__ == "__main__":
    main()
