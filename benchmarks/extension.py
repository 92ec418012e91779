"""Convergent extension by tuning tensions: one adjoint against finite differences over all edges.

    python benchmarks/extension.py [--cells 50 100 200 500] [--edges 3]

A periodic tissue with a tension for each edge is in equilibrium, and so is the shape of its box, of fixed
area. Measured are the seconds (without compilation) of one gradient of the aspect ratio of the box with
respect to all tensions, and of one relaxation that begins at the equilibrium; central differences need two
for each edge. The speed-up is the time of the differences for all edges over that of the gradient. The
last column is the largest deviation of the gradient from the differences of `--edges` edges, relative to
the largest entry.
"""

import argparse

import equinox as eqx
import jax
import numpy as np
from _arguments import count
from _timing import first_and_best

import vertax as vx
from vertax.costs import aspect_ratio
from vertax.mechanics import BoxRelaxation

jax.config.update("jax_enable_x64", True)
STEP = 1e-3


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure the gradient of an extension.")
    parser.add_argument("--cells", type=count, nargs="+", default=[50, 100, 200, 500])
    parser.add_argument("--edges", type=int, default=3, help="edges with differences")
    chosen = parser.parse_args()
    response = BoxRelaxation(free="shape", relaxation=vx.Relaxation(contact_range=None))
    print("cells  edges  gradient  relaxation  speed-up  difference")
    for n_cells in chosen.cells:
        start = vx.initialise.periodic_voronoi(n_cells=n_cells, key=0, lloyd_steps=2)
        logits = 0.5 * jax.random.normal(jax.random.key(1), (start.n_edges,))
        tension = 0.04 + 0.24 * jax.nn.sigmoid(logits)
        energy = vx.energies.foam_energy(tension)

        @eqx.filter_jit
        def ratio(energy, tissue):
            end = response(tissue, energy, throw=False)
            return aspect_ratio(end.tissue, "box"), end

        gradient = eqx.filter_jit(eqx.filter_grad(lambda e, t: ratio(e, t)[0]))
        tissue = ratio(energy, start)[1].checked().tissue
        _, of_gradient = first_and_best(gradient, energy, tissue, repeats=2)
        logits_of = lambda e: e.terms[1].logits
        slopes = np.asarray(logits_of(gradient(energy, tissue)))
        edges = np.argsort(-np.abs(slopes))[:: max(1, tissue.n_edges // (2 * chosen.edges))]
        seconds, off = [], []
        for edge in edges[: chosen.edges]:
            ends = []
            for sign in (1, -1):
                logits = logits_of(energy).at[edge].add(sign * STEP)
                moved = eqx.tree_at(logits_of, energy, logits)
                seconds.append(first_and_best(ratio, moved, tissue, repeats=1)[1])
                ends.append(float(ratio(moved, tissue)[0]))
            off.append(abs((ends[0] - ends[1]) / (2 * STEP) - slopes[edge]))
        relaxation = float(np.mean(seconds))
        speed_up = 2 * tissue.n_edges * relaxation / of_gradient
        print(
            f"{n_cells:5d}  {tissue.n_edges:5d}  {of_gradient:8.3f}  {relaxation:10.3f}  {speed_up:8.0f}  "
            f"{max(off) / np.abs(slopes).max():10.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
