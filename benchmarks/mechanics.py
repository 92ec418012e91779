"""Moduli and modes of a tissue at rest.

    python benchmarks/mechanics.py [--cells 100 1000] [--modes 20]

Printed are the seconds (the best of three, without compiling) of the elastic tensor, relaxed and affine,
of its gradient with respect to all target shape factors as a share of that, of the softest modes, and of the
complex modulus at ten frequencies.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
from _arguments import count
from _timing import first_and_best

import vertax as vx
from vertax import mechanics

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure moduli and modes.")
    parser.add_argument("--cells", type=count, nargs="+", default=[100, 1000])
    parser.add_argument("--modes", type=count, default=20)
    chosen = parser.parse_args()
    omegas = jnp.geomspace(1e-2, 1e2, 10)
    friction = vx.dissipations.SubstrateFriction(1.0)
    print("cells  tensor  affine  gradient/tensor   modes  oscillation")
    best = lambda *call: first_and_best(*call, repeats=3)[1]
    for n_cells in chosen.cells:
        start = vx.initialise.periodic_voronoi(n_cells=n_cells, key=0)
        energy = vx.energies.ShapeFactorEnergy(jnp.full(n_cells, 3.7))
        tissue = vx.equilibrate(start, energy, contact_range=None).tissue

        def shear(energy, tissue=tissue):
            return mechanics.shear_modulus(tissue, energy, throw=False)

        relaxed = best(lambda e, t=tissue: mechanics.elastic_tensor(t, e), energy)
        affine = best(lambda e, t=tissue: mechanics.elastic_tensor(t, e, affine=True), energy)
        gradient = best(eqx.filter_jit(eqx.filter_grad(shear)), energy)
        modes = best(lambda e, t=tissue: mechanics.modes(t, e, chosen.modes).values, energy)
        oscillation = best(
            lambda e, t=tissue: mechanics.complex_modulus(t, e, friction, omegas), energy
        )
        print(
            f"{n_cells:5d}  {relaxed:6.3f}  {affine:6.3f}  {gradient / relaxed:15.2f}  {modes:6.3f}  "
            f"{oscillation:11.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
