"""Time of the tensions of many masks: 50 label images of about 80 cells.

    python benchmarks/masks.py [--masks 50] [--cells 80]

Prints seconds of `infer_tensions_of_masks` (compilation included) and of `vertax run infer_tensions`, with
its tables, maps and animation.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from vertax.tensions import infer_tensions_of_masks


def label_image(n_cells: int, side: int, rng: np.random.Generator) -> np.ndarray:
    """A disc of Voronoi cells after three Lloyd steps."""
    pixels = np.indices((side, side)).reshape(2, -1).T + 0.5
    inside = np.hypot(*(pixels - side / 2).T) < 0.48 * side
    seeds = pixels[rng.choice(np.flatnonzero(inside), n_cells, replace=False)]
    nearest = KDTree(seeds).query(pixels[inside])[1]
    for _ in range(3):
        sums = [np.bincount(nearest, x, n_cells) for x in pixels[inside].T]
        seeds = np.stack(sums, axis=1) / np.bincount(nearest, minlength=n_cells)[:, None]
        nearest = KDTree(seeds).query(pixels[inside])[1]
    labels = np.zeros(side**2, np.uint16)
    labels[inside] = nearest + 1
    return labels.reshape(side, side)


def main() -> None:
    """Draw the masks, and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--masks", type=int, default=50)
    parser.add_argument("--cells", type=int, default=80)
    parser.add_argument("--side", type=int, default=900, help="pixels")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(options.masks):
            n_cells = options.cells + int(rng.integers(-5, 6))
            np.save(folder / f"mask{k}.npy", label_image(n_cells, options.side, rng))
        start, cpu = time.perf_counter(), time.process_time()
        masks = infer_tensions_of_masks(folder)
        seconds = time.perf_counter() - start, time.process_time() - cpu
        print(
            f"{len(masks.results)} masks: {seconds[0]:.0f} s, {seconds[1]:.0f} s of CPU",
            flush=True,
        )
        start = time.perf_counter()
        command = ["-m", "vertax", "run", "infer_tensions", "--quiet"]
        command += ["--set", f"image={folder}/*.npy", "--output", f"{folder}/run"]
        subprocess.run([sys.executable, *command], check=True)
        print(f"vertax run: {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
