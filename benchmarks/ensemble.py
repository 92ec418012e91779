"""Ensembles: the time of a tissue in a batch against that of the same tissues one by one.

    python benchmarks/ensemble.py [--cells 20 64] [--tissues 100 1000] [--shape-factor 3.7] [--no-vmap]

Random tissues of so many cells relax, as many as there are tissues for that size. Printed is the time of a
tissue (without compiling) where each is a call of a compiled function, and over that: all in one
`vx.fitting.for_each` (on a CPU one after another), `jax.lax.map`, `jax.vmap` (in lots of 100, which takes
long), and `for_each` of two halves in two devices, which this script makes of the cores of a CPU, by
`jax.shard_map`.
"""

import argparse
import os

os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _arguments import count
from _timing import first_and_best
from jax.sharding import Mesh, PartitionSpec

import vertax as vx

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure ensembles.")
    parser.add_argument("--cells", type=count, nargs="+", default=[20, 64])
    parser.add_argument("--tissues", type=count, nargs="+", default=[100, 1000])
    parser.add_argument("--shape-factor", type=float, default=3.7)
    parser.add_argument("--no-vmap", action="store_true")
    chosen = parser.parse_args()
    mesh, spec = Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch")
    print("cells  tissues  one by one, ms  for_each  lax.map   vmap  two devices")
    for n_cells, n_tissues in zip(chosen.cells, chosen.tissues, strict=True):
        tissues = [vx.initialise.periodic_voronoi(n_cells, key=k) for k in range(n_tissues)]
        energy = vx.energies.ShapeFactorEnergy(jnp.asarray(chosen.shape_factor))
        arrays, static = eqx.partition(tissues, eqx.is_array)
        batch = jax.tree.map(lambda *x: jnp.stack(x), *arrays)

        def relaxed(one, static=static[0], energy=energy):
            tissue = eqx.combine(one, static)
            return vx.equilibrate(tissue, energy, throw=False).energy

        alone = jax.jit(relaxed)
        ways = {
            "for_each": lambda batch, f=relaxed: vx.fitting.for_each(f)(batch),
            "map": lambda batch, f=relaxed: jax.lax.map(f, batch),
            "vmap": lambda batch, f=relaxed: jax.lax.map(f, batch, batch_size=100),
            "devices": jax.shard_map(
                lambda part, f=relaxed: vx.fitting.for_each(f)(part),
                mesh=mesh,
                in_specs=spec,
                out_specs=spec,
                check_vma=False,
            ),
        }
        every = lambda arrays, f=alone: [f(one) for one in arrays]
        single = first_and_best(every, arrays, repeats=2)[1] / n_tissues
        shares = [
            float("nan")
            if name == "vmap" and chosen.no_vmap
            else first_and_best(jax.jit(way), batch, repeats=2)[1] / n_tissues / single
            for name, way in ways.items()
        ]
        print(
            f"{n_cells:5d}  {n_tissues:7d}  {1e3 * single:14.2f}  {shares[0]:8.2f}  {shares[1]:7.2f}  "
            f"{shares[2]:5.2f}  {shares[3]:11.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
