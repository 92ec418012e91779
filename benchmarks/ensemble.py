"""Relaxation of ensembles: time per tissue in a batch against that of separate calls.

    python benchmarks/ensemble.py [--cells 20 64] [--tissues 100 1000] [--shape-factor 3.7]

The first number is the time per tissue, without compilation, of one call of a compiled function for each
tissue. The others are ratios to it: all tissues by one `jax.vmap` (a loop on a CPU), by `jax.lax.map`, and by
`jax.vmap` on each half of the batch on two devices with `jax.shard_map` (this script makes two devices of the
cores of a CPU).
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
    chosen = parser.parse_args()
    mesh, spec = Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch")
    print("cells  tissues  one by one, ms   vmap  lax.map  two devices")
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
            "vmap": jax.vmap(relaxed),
            "map": lambda batch, f=relaxed: jax.lax.map(f, batch),
            "devices": jax.shard_map(
                jax.vmap(relaxed), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
            ),
        }
        every = lambda arrays, f=alone: [f(one) for one in arrays]
        single = first_and_best(every, arrays, repeats=2)[1] / n_tissues
        ratios = [
            first_and_best(jax.jit(way), batch, repeats=2)[1] / n_tissues / single
            for way in ways.values()
        ]
        print(
            f"{n_cells:5d}  {n_tissues:7d}  {1e3 * single:14.2f}  {ratios[0]:5.2f}  {ratios[1]:7.2f}  "
            f"{ratios[2]:11.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
