"""Tensions and pressures inferred from shapes with known tensions: accuracy, error bars and run time.

The shapes are foams of Surface Evolver (`--data`), exact and as images of 1000 and 500 pixels, and
synthetic clusters as images with rough outlines. For comparison each row has the unweighted balance of
forces: non-negative least squares at inner junctions, with the tangents of arcs. With `--forsys PYTHON`,
the interpreter of an environment that has ForSys (`pip install forsys`), rows for its static inference of
the same foams and its dynamic inference of the movie follow. The last rows are real masks without known
tensions: the number of determined edges.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _arguments import count
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import nnls

import vertax as vx
from vertax.inference import label_image, pearson
from vertax.tensions import InferredTensions, infer_tensions

jax.config.update("jax_enable_x64", True)

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "surface_evolver"
HEADER = (
    f"{'what':>34} | determined | r tension | error | r pressure | "
    "within 1, 1.96 s.d., both | s | bare: r, error"
)
# Run by the interpreter of ForSys: inner edges, true and inferred tensions scaled to mean 1.
FORSYS = """
import sys, time
import numpy as np
import forsys as fs
import forsys.surface_evolver
began = time.time()
lattice = fs.surface_evolver.SurfaceEvolver(sys.argv[1])
frame = fs.frames.Frame(0, lattice.vertices, lattice.edges, lattice.cells, time=0, gt=True)
system = fs.ForSys({0: frame})
system.build_force_matrix(when=0)
system.solve_stress(when=0, allow_negatives=False)
rows = [
    (e.gt, e.tension) for e in system.frames[0].big_edges.values() if not e.external
]
true, found = np.array(rows, float).T
true, found = true / true.mean(), found / found.mean()
print(len(true), np.corrcoef(true, found)[0, 1], np.mean(abs(found - true) / true), time.time() - began)
"""

# The same for a movie; the frame is the first argument.
FORSYS_MOVIE = """
import sys, time
import numpy as np
import forsys as fs
import forsys.surface_evolver
began, when = time.time(), int(sys.argv[1])
frames = {}
for number, path in enumerate(sys.argv[2:]):
    lattice = fs.surface_evolver.SurfaceEvolver(path)
    frames[number] = fs.frames.Frame(
        number, lattice.vertices, lattice.edges, lattice.cells, time=number, gt=True
    )
system = fs.ForSys(frames)
system.build_force_matrix(when=when)
system.solve_stress(when=when, b_matrix="velocity", velocity_normalization=0.1, method="lsq_linear")
rows = [(e.gt, e.tension) for e in system.frames[when].big_edges.values() if not e.external]
true, found = np.array(rows, float).T
true, found = true / true.mean(), found / found.mean()
print(len(true), np.corrcoef(true, found)[0, 1], np.mean(abs(found - true) / true), time.time() - began)
"""


class Truth(NamedTuple):
    """A tissue with its tensions and pressures."""

    tissue: vx.Tissue
    tension: np.ndarray
    pressure: np.ndarray
    foam: vx.io.Foam | None = None


def compare(truth: Truth, result: InferredTensions) -> tuple[np.ndarray, ...]:
    """True and inferred tensions, their standard scores, the same of pressures, and standard deviations."""
    tissue = truth.tissue
    exact = result.pixel_size is None
    # An exact shape has the cells of the truth; an image labels them from 1.
    cell = np.append(np.arange(tissue.n_cells) if exact else result.labels - 1, tissue.n_cells)
    pairs = np.sort(np.asarray(tissue.topology.edge_cells), axis=1).tolist()
    number = {tuple(pair): k for k, pair in enumerate(pairs) if pairs.count(pair) == 1}
    between = np.sort(cell[np.asarray(result.tissue.topology.edge_cells)], axis=1).tolist()
    edge = np.array([number.get(tuple(pair), -1) for pair in between])
    use = result.determined & (edge >= 0)
    true, inferred = truth.tension[edge[use]], result.tensions[use]
    scale = true.mean() / inferred.mean()
    scores = (inferred - true / scale) / result.tension_deviations[use]
    certain = result.pressures_determined
    length = np.sqrt(np.mean(np.asarray(tissue.areas)) / np.mean(np.asarray(result.tissue.areas)))
    pressure = truth.pressure[cell[:-1][certain]] / scale * length
    away = result.pressures[certain] - pressure + pressure.mean() - result.pressures[certain].mean()
    return (
        true / true.mean(),
        inferred / inferred.mean(),
        scores,
        pressure,
        result.pressures[certain],
        away / result.pressure_deviations[certain],
        result.tension_deviations[use],
        result.pressure_deviations[certain],
    )


def bare(result: InferredTensions) -> InferredTensions:
    """The same with tensions from non-negative least squares, with equal weights of all inner junctions."""
    tissue, m = result.tissue, result.tissue.topology
    edge, forward = np.asarray(m.edge).reshape(-1, 3), np.asarray(m.forward).reshape(-1, 3)
    inner = np.all(np.asarray(m.cell).reshape(-1, 3) < tissue.n_cells, axis=1)
    chord = np.asarray(tissue.edge_vectors)
    direction, angle = np.arctan2(chord[:, 1], chord[:, 0]), np.asarray(tissue.edge_angles)
    away = np.where(forward, (direction - angle)[edge], (direction + angle)[edge] + np.pi)[inner]
    asked = np.isfinite(result.tensions)
    matrix = np.zeros((2, inner.sum(), tissue.n_edges))
    row = np.arange(inner.sum())[:, None]
    np.add.at(matrix[0], (row, edge[inner]), np.cos(away))
    np.add.at(matrix[1], (row, edge[inner]), np.sin(away))
    forces = np.concatenate([*matrix, np.full((1, tissue.n_edges), 1e3)])[:, asked]
    given = np.append(np.zeros(2 * inner.sum()), 1e3 * asked.sum())
    tensions = result.tensions.copy()
    tensions[asked] = nnls(forces, given, maxiter=50 * len(given))[0]
    return eqx.tree_at(lambda r: r.tensions, result, tensions)


def row(name: str, cases: Sequence[tuple[Truth, object]]) -> None:
    """Infer the tensions of all cases, and print a row of results."""
    parts, determined, seconds, plain = [], [], [], []
    for truth, image in cases:
        began = time.perf_counter()
        result = infer_tensions((truth.foam or truth.tissue) if image is None else image)  # pyright: ignore[reportArgumentType]
        seconds.append(time.perf_counter() - began)
        asked = np.isfinite(result.tensions).sum()
        determined.append(result.determined.sum() / asked)
        if result.determined.sum() > 2:
            parts.append(compare(truth, result))
            plain.append(compare(truth, bare(result)))
    if not parts:
        print(f"{name:>34} | {np.mean(determined):10.0%} | nothing is determined", flush=True)
        return
    r = np.mean([pearson(p[0], p[1]) for p in parts])
    error = np.mean([np.mean(np.abs(p[1] - p[0]) / p[0]) for p in parts])
    by_pressure = np.mean([pearson(p[3], p[4]) for p in parts])
    scores = [np.abs(np.concatenate([p[k] for p in parts])) for k in (2, 5)]
    cover = [f"{np.mean(s < 1):4.0%} {np.mean(s < 1.96):4.0%}" for s in scores]
    print(
        f"{name:>34} | {np.mean(determined):10.0%} | {r:9.4f} | {error:5.1%} | {by_pressure:10.4f} | "
        f"{cover[0]:>18} {cover[1]:>20} | {np.median(seconds):.1f} | "
        f"{np.mean([pearson(p[0], p[1]) for p in plain]):.4f} "
        f"{np.mean([np.mean(np.abs(p[1] - p[0]) / p[0]) for p in plain]):5.1%}",
        flush=True,
    )


def foam(path: Path) -> Truth:
    """A foam of Surface Evolver."""
    read = vx.io.read_surface_evolver(path)
    return Truth(read.tissue, np.asarray(read.tensions), np.asarray(read.pressures), read)


def cluster(n_cells: int, seed: int) -> Truth:
    """A cluster in equilibrium."""
    keys = jax.random.split(jax.random.key(seed), 3)
    tissue = vx.initialise.free_voronoi(n_cells, key=keys[0], lloyd_steps=3, inner_arcs=True)
    tension = 1 + 0.25 * jax.random.truncated_normal(keys[1], -2, 2, (tissue.n_edges,))
    areas = jax.random.uniform(keys[2], (n_cells,), minval=0.9, maxval=1.3)
    area = vx.energies.AreaElasticity(20.0, areas)
    relaxed = vx.equilibrate(tissue, area + vx.energies.LineTension(tension), throw=False).tissue
    return Truth(relaxed, np.asarray(tension), np.asarray(area.pressures(relaxed)))


def drawn(
    truth: Truth, pixels_per_cell: int, rough: float, random: np.random.Generator
) -> np.ndarray:
    """A label image of the cluster, rotated at random, its outlines displaced by `rough` pixels (r.m.s.)."""
    angle = random.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = truth.tissue.with_vertices(jnp.asarray(np.asarray(truth.tissue.vertices) @ turn.T))
    points = np.asarray(turned.vertices)
    side = np.ptp(points, axis=0).max() / np.sqrt(np.mean(np.asarray(turned.areas)))
    labels = label_image(turned, int(pixels_per_cell * side / 0.9))
    if rough:
        place = np.indices(labels.shape).astype(float)
        for axis in range(2):
            waves = gaussian_filter(random.normal(size=labels.shape), 4.0)
            place[axis] += rough * waves / waves.std()
        labels = map_coordinates(labels, place, order=0)
    return labels


def forsys(interpreter: str, name: str, program: str, arguments: Sequence[object]) -> None:
    """Print a row of results of ForSys."""
    command = [interpreter, "-c", program, *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True)
    last = (process.stdout.strip() or process.stderr.strip() or "nothing").splitlines()[-1]
    print(f"{name:>34} | edges, r, error, s: {last}", flush=True)


def main() -> None:
    """Print one row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of dumps")
    parser.add_argument(
        "--sizes", type=count, nargs="*", default=[20, 100, 300], help="cells of clusters"
    )
    parser.add_argument("--repeats", type=count, default=3, help="images of each cluster")
    parser.add_argument("--forsys", help="interpreter that has ForSys")
    arguments = parser.parse_args()
    print(HEADER)
    for path in sorted(arguments.data.glob("*.dmp")):
        truth = foam(path)
        row(f"{path.stem}, exact", [(truth, None)])
        for pixels in (1000, 500):
            row(
                f"{path.stem}, {pixels} pixels",
                [(truth, label_image(truth.foam or truth.tissue, pixels))],
            )
        if arguments.forsys:
            forsys(arguments.forsys, f"{path.stem}, ForSys", FORSYS, [path])
    movie = sorted(arguments.data.glob("movie_[1-9].dmp"))
    if arguments.forsys and len(movie) > 2:
        when = len(movie) // 2
        name = f"{movie[when].stem}, ForSys, dynamic"
        forsys(arguments.forsys, name, FORSYS_MOVIE, [when, *movie])
    random = np.random.default_rng(0)
    for n in arguments.sizes:
        truths = [cluster(n, seed) for seed in range(max(1, 40 // n))]
        for pixels in (20, 50, 150):
            for rough in (0.0, 0.3, 0.6) if pixels * n <= 50 * 300 else ():
                cases = [
                    (truth, drawn(truth, pixels, rough, random))
                    for truth in truths
                    for _ in range(arguments.repeats)
                ]
                row(f"{n} cells, {pixels} px each, rough {rough}", cases)
    for path in sorted((arguments.data.parent / "segmentations").glob("*.tif")):
        began = time.perf_counter()
        result = infer_tensions(path)
        seconds = time.perf_counter() - began
        asked = np.isfinite(result.tensions).sum()
        print(
            f"{path.stem:>34} | {result.determined.sum()} of {asked}, s.d. "
            f"{np.median(result.tension_deviations[result.determined]):.2f}, {seconds:.1f} s; "
            f"{result.warnings}"
        )


if __name__ == "__main__":
    main()
