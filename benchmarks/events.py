"""Cost of a changing number of cells: time of an event, and of relaxations with spare slots.

Prints the time of one division, one removal and one sweep of T2 transitions, within one compiled program; and
the additional time of a relaxation if a quarter of the slots is spare.
"""

from __future__ import annotations

import argparse

import equinox as eqx
import jax
from _arguments import count
from _timing import first_and_best

import vertax as vx
from vertax.transitions import divide, remove

jax.config.update("jax_enable_x64", True)

ENERGY = vx.energies.AreaElasticity(1.0, 1.0) + vx.energies.PerimeterElasticity(0.1, 3.6)
EVENTS = 20


@eqx.filter_jit
def divisions(tissue: vx.Tissue) -> vx.Tissue:
    """`EVENTS` divisions, one after the other."""
    return jax.lax.fori_loop(0, EVENTS, lambda i, t: divide(t, i, throw=False).tissue, tissue)


@eqx.filter_jit
def removals(tissue: vx.Tissue) -> vx.Tissue:
    """`EVENTS` removals, one after the other."""
    return jax.lax.fori_loop(0, EVENTS, lambda i, t: remove(t, 2 * i, throw=False).tissue, tissue)


@eqx.filter_jit
def sweeps(tissue: vx.Tissue) -> vx.Tissue:
    """`EVENTS` sweeps of T2 transitions without a transition, as in most steps of a relaxation."""
    rule = vx.T2()
    once = lambda _, t: rule.sweep(t, ENERGY, rule.init(t))[0]
    return jax.lax.fori_loop(0, EVENTS, once, tissue)


@eqx.filter_jit
def relax(tissue: vx.Tissue) -> vx.Equilibrium:
    """A relaxation."""
    return vx.equilibrate(tissue, ENERGY, throw=False)


def main() -> None:
    """Print one row for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=count, nargs="*", default=[100, 500])
    chosen = parser.parse_args()
    print(
        "cells | ms an event: division  removal  T2 sweep | ms of a relaxation: plain  25 % spare  more"
    )
    for n in chosen.cells:
        tissue = vx.initialise.periodic_voronoi(n, key=n, lloyd_steps=3)
        roomy = tissue.with_capacity(n + max(n // 3, EVENTS))
        times = [1e3 * first_and_best(f, roomy)[1] / EVENTS for f in (divisions, removals, sweeps)]
        plain = 1e3 * first_and_best(relax, tissue)[1]
        spare = 1e3 * first_and_best(relax, tissue.with_capacity(-(-4 * n // 3)))[1]
        print(
            f"{n:5d} | {times[0]:22.3f} {times[1]:8.3f} {times[2]:9.3f} |"
            f" {plain:25.1f} {spare:11.1f} {spare / plain - 1:5.0%}",
            flush=True,
        )


if __name__ == "__main__":
    main()
