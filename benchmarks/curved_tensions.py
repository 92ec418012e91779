"""Errors of tensions inferred on a sphere, with and without the heights.

    python benchmarks/curved_tensions.py [--foams 20]

Foams of 20 cells at rest are projected to spheres of several radii, and drawn with 60 pixels a cell. For each
radius: the largest slope, and the relative error (root mean square) and the share of tensions within 1 and
1.96 standard deviations, first with the heights of the pixels, then from the projection alone.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import jax
import numpy as np
from _arguments import count
from inference import compare, foam
from tension_coverage import relaxed

from vertax.inference import label_image, labels_on_sphere
from vertax.tensions import infer_tensions

jax.config.update("jax_enable_x64", True)

PIXELS = 400
FINE = 4
"""Pixels of the planar foam along a pixel of the image."""
RADII = (1e6, 800.0, 400.0, 250.0, 200.0)
"""Radii of the spheres, in pixels; the first one is a plane."""


def main() -> None:
    """Print a row for each radius."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--foams", type=count, default=20, help="number of foams")
    parser.add_argument("--folder", type=Path, help="folder where foams are kept")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp())
    truths = [foam(relaxed(folder, seed)[0]) for seed in range(arguments.foams)]
    print("slope | with heights: error, within 1, 1.96 s.d. | without: error, within 1, 1.96 s.d.")
    for radius in RADII:
        slopes, texts = [], []
        for lifts in (True, False):
            scores, errors = [], []
            for truth in truths:
                fine = label_image(truth.foam or truth.tissue, FINE * PIXELS)
                labels, heights = (
                    image[FINE // 2 :: FINE, FINE // 2 :: FINE]
                    for image in labels_on_sphere(fine, FINE * radius)
                )
                result = infer_tensions(labels, height=heights / FINE if lifts else None)
                true, inferred, score, *_ = compare(truth, result)
                scores.append(np.abs(score))
                errors.append(inferred / true - 1)
                if result.curved is not None:
                    slopes.append(result.curved.slopes.max())
            z, e = np.concatenate(scores), np.concatenate(errors)
            rms = np.sqrt(np.mean(e**2))
            texts.append(f"{rms:6.1%} {np.mean(z < 1):4.0%} {np.mean(z < 1.96):4.0%}")
        print(f"{np.mean(slopes):5.2f} | {texts[0]} | {texts[1]}", flush=True)


if __name__ == "__main__":
    main()
