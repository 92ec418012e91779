"""Time of the tensions of many masks, 50 label images of about 80 cells, and of large ones.

    python benchmarks/masks.py [--masks 50] [--cells 80] [--sizes 100 343 1000 5000]

Prints, for masks of the given numbers of cells, seconds and peak memory of `infer_tensions`, each in a new
process: the first call, and a second one, which compiles nothing. Then the seconds of
`infer_tensions_of_masks` (compilation included) and of `vertax run infer_tensions`, with its tables, maps and
animation.
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


# Run in a new process: its peak memory is that of the inference.
LARGE = """
import resource, sys, time
import numpy as np
from vertax.tensions import infer_tensions
mask, seconds = np.load(sys.argv[1]), []
for _ in range(2):
    start, cpu = time.perf_counter(), time.process_time()
    result = infer_tensions(mask)
    seconds += [time.perf_counter() - start, time.process_time() - cpu]
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print("{:8} cells | first {:6.1f} s, CPU {:6.1f} s | again {:6.1f} s, CPU {:6.1f} s | {:.2f} GB".format(
    result.tissue.n_cells, *seconds, memory), flush=True)
"""


def large(n_cells: int, folder: Path) -> None:
    """Print time and memory of a mask with as many pixels for each cell as 4000 x 4000 for 5000 cells."""
    file = folder / f"large{n_cells}.npy"
    side = round(4000 * np.sqrt(n_cells / 5000))
    np.save(file, label_image(n_cells, side, np.random.default_rng(n_cells)))
    subprocess.run([sys.executable, "-c", LARGE, str(file)], check=True)


def main() -> None:
    """Draw the masks, and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--masks", type=int, default=50)
    parser.add_argument("--cells", type=int, default=80)
    parser.add_argument("--sizes", type=int, nargs="*", default=[100, 343, 1000, 5000])
    parser.add_argument("--side", type=int, default=900, help="pixels")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for n_cells in options.sizes:
            large(n_cells, folder)
        if not options.masks:
            return
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
