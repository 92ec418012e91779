"""Tensions of 12 pupal wings of flies from vertices and straight edges: anisotropy, two halves, run time.

Columns: numbers of cells and tensions; standard deviation of the prior (independent, in regions); direction
of the mean stress from the proximal-distal axis, which is x in the files, in degrees, with its standard
deviation; anisotropy; share of the tensions that agree within 1.96 standard deviations when each half of the
junctions, chosen at random, is used alone; seconds of one core.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import vertax as vx
from vertax.tensions import infer_tensions
from vertax.tensions._edges import solution, vertices_only
from vertax.tensions._observed_geometry import observed_geometry
from vertax.tensions._outcome import relative

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "wings"


def halves(tissue: vx.Tissue, random: np.random.Generator) -> np.ndarray:
    """Standard scores of the differences of tensions inferred from two halves of the junctions."""
    geometry = observed_geometry(tissue)
    first = random.random(geometry.n_vertices) < 0.5
    parts = []
    for half in (first, ~first):
        part = geometry._replace(inner=geometry.inner & half)
        curves = vertices_only(part, 0.01 * part.size)
        uncertain = np.zeros(tissue.n_edges, bool)
        options = {"straight": True, "known_noise": False, "prior": None}
        system, balance = solution(part, curves, uncertain, **options)
        result = relative(balance, system.which, curves)
        values = np.full((2, tissue.n_edges), np.nan)
        values[:, system.which.edges] = result.tension, result.tension_deviation
        parts.append(values)
    (a, b), (c, d) = parts
    scores = (a - c) / np.hypot(b, d)
    return scores[np.isfinite(scores)]


def main() -> None:
    """Print a row for each wing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the files")
    random = np.random.default_rng(0)
    for path in sorted(parser.parse_args().data.glob("*.dat")):
        tissue = vx.io.read_force_inference(path).tissue
        began = time.process_time()
        result = infer_tensions(tissue)
        seconds = time.process_time() - began
        stress, errors = result.mean_stress, result.errors
        size = float(np.sqrt(np.mean(np.asarray(tissue.areas))))
        scores = np.abs(halves(tissue, random))
        print(
            f"{path.stem:>15} | {stress.n_cells:4} {np.isfinite(result.tensions).sum():4} | "
            f"{errors['tension']:.2f} {errors['region']:.2f} | {np.degrees(stress.direction):5.1f} ± "
            f"{np.degrees(stress.direction_deviation):4.1f} | {stress.anisotropy * size:.3f} ± "
            f"{stress.anisotropy_deviation * size:.3f} | {np.mean(scores < 1.96):4.0%} | "
            f"{seconds:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
