"""Tissues of known tensions and pressures: foams of Surface Evolver, and Voronoi tissues."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Voronoi

import vertax as vx

PIECES = 8
"""Straight pieces of an edge."""
# Step of the gradient descent in motion, at a mean area of 1.
_MOVE = "m 0.002"
_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def start(n_cells: int, seed: int) -> vx.Tissue:
    """A Voronoi cluster with arcs."""
    key = jax.random.key(seed)
    return vx.initialise.free_voronoi(n_cells, key=key, lloyd_steps=2, inner_arcs=True)


def grouped(tissue: vx.Tissue, spread: float, seed: int, patches: bool) -> np.ndarray:
    """Tensions of mean 1 in five groups of edges, chosen at random or in patches of the tissue."""
    random = np.random.default_rng(seed)
    group = random.integers(5, size=tissue.n_edges)
    if patches:
        middle = np.asarray(tissue.edge_points(jnp.array([0.5])))[:, 0]
        centres = middle[random.choice(len(middle), 5, replace=False)]
        group = np.argmin(np.linalg.norm(middle[:, None] - centres, axis=2), axis=1)
    tension = 1 + spread * np.linspace(-1, 1, 5)[group]
    return tension / tension.mean()


def restless(tissue: vx.Tissue, seed: int) -> np.ndarray:
    """Tensions of five classes, a few of them weak, before they are scaled to mean 1."""
    random = np.random.default_rng(seed)
    classes, weights = [0.1, 0.67, 0.93, 1.46, 1.62], [0.06, 0.22, 0.24, 0.24, 0.24]
    tension = random.choice(classes, tissue.n_edges, p=weights)
    return tension / tension.mean()


def furrow(tissue: vx.Tissue, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Tensions that are high along a line, and areas, of a cluster that bends strongly."""
    random = np.random.default_rng(seed)
    middle = np.asarray(tissue.edge_points(jnp.array([0.5])))[:, 0]
    line = np.exp(-np.square((middle - middle.mean(axis=0))[:, 1]))
    tension = (0.7 + 0.9 * line) * (1 + 0.15 * random.uniform(-1, 1, tissue.n_edges))
    areas = np.asarray(tissue.areas) * random.uniform(0.7, 1.4, tissue.n_cells)
    return tension / tension.mean(), areas


def voronoi(n_cells: int, seed: int, noise: float = 0.0) -> tuple[vx.Tissue, np.ndarray]:
    """A Voronoi tissue, in balance with equal pressures and tensions equal to the distance of the centres.

    Its dual has an edge across each edge, so that the forces at a vertex, turned by a right angle, are the
    sides of a triangle (Maxwell 1864). `noise` displaces the vertices.
    """
    random = np.random.default_rng(seed)
    side = np.sqrt(n_cells) + 2
    seeds = random.uniform(0, side, (round(side**2), 2))
    for _ in range(2):
        regions = Voronoi(np.concatenate([seeds, *(seeds + side * np.array(k) for k in _AROUND)]))
        cells = [regions.regions[regions.point_region[k]] for k in range(len(seeds))]
        seeds = np.array([regions.vertices[c].mean(axis=0) for c in cells])
    regions = Voronoi(seeds)
    inside = np.all((seeds > 1) & (seeds < side - 1), axis=1)
    cells = [regions.regions[regions.point_region[k]] for k in np.flatnonzero(inside)]
    used, corners = np.unique(np.concatenate(cells), return_inverse=True)
    parts = np.split(corners, np.cumsum([len(c) for c in cells])[:-1])
    polygons = [list(map(int, p)) for p in parts]
    tissue = None
    for attempt in range(50):
        points = regions.vertices[used] + noise * random.normal(size=(len(used), 2))
        try:
            tissue = vx.initialise.from_polygons(points, polygons).tissue
            break
        except ValueError:  # sides of a short edge cross
            if attempt == 49:
                raise
    assert tissue is not None
    sides = np.append(np.flatnonzero(inside), -1)[np.asarray(tissue.topology.edge_cells)]
    length = np.linalg.norm(seeds[sides[:, 0]] - seeds[sides[:, 1]], axis=1)
    return tissue, np.where(np.any(sides < 0, axis=1), np.nan, length)


def write_evolver(
    path: Path,
    tissue: vx.Tissue,
    tension: np.ndarray,
    areas: np.ndarray | None = None,
    pieces: int = PIECES,
) -> None:
    """Write a tissue of arcs as a file of Surface Evolver, each edge a chain of straight pieces.

    By default cells keep their areas.
    """
    m, n = tissue.topology, tissue.n_vertices
    cell, edge, forward, twin = (np.asarray(x) for x in (m.cell, m.edge, m.forward, m.twin))
    areas = np.asarray(tissue.areas) if areas is None else areas
    inner = np.asarray(tissue.edge_points(jnp.arange(1, pieces) / pieces), float)
    points = np.concatenate([np.asarray(tissue.vertices, float), inner.reshape(-1, 2)])
    half = np.flatnonzero(forward)
    half = half[np.argsort(edge[half])]
    between = n + np.arange(tissue.n_edges * (pieces - 1)).reshape(tissue.n_edges, -1)
    chain = np.column_stack([half // 3, between, twin[half] // 3]) + 1
    number = np.arange(1, tissue.n_edges * pieces + 1).reshape(tissue.n_edges, pieces)
    lines = ["SPACE_DIMENSION 2", "STRING", "vertices"]
    lines += [f"{k} {x:.12g} {y:.12g}" for k, (x, y) in enumerate(points, 1)]
    lines.append("edges")
    for ids, first, last, pull in zip(number, chain[:, :-1], chain[:, 1:], tension, strict=True):
        lines += [
            f"{k} {a} {b} density {pull:.9g}" for k, a, b in zip(ids, first, last, strict=True)
        ]
    lines.append("faces")
    for face in range(tissue.n_cells):
        h = begin = int(np.flatnonzero(cell == face)[0])
        loop = []
        while not loop or h != begin:
            loop += (number[edge[h]] if forward[h] else -number[edge[h]][::-1]).tolist()
            h = int(3 * (twin[h] // 3) + (twin[h] % 3 + 2) % 3)
        lines.append(f"{face + 1} " + " ".join(map(str, loop)))
    lines.append("bodies")
    lines += [f"{k} {k} volume {area:.12g}" for k, area in enumerate(areas, 1)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def run_evolver(file: Path, script: str) -> str:
    """Run a script of Surface Evolver and return what it prints."""
    program = shutil.which("evolver")
    if program is None:
        raise SystemExit("Surface Evolver is missing: apt install surface-evolver")
    commands = file.with_suffix(".cmd")
    commands.write_text(f"quiet on\n{script}\nq\nq\n", encoding="utf-8")
    command = [program, "-x", f"-f{commands}", str(file)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=500)
    return process.stdout + process.stderr


def to_rest(file: Path, times: int = 200) -> Path:
    """Let a foam relax, and return the file of its state."""
    dump = file.with_suffix(".dmp")
    run_evolver(file, f'm 0.004\n{{ g 50; V }} {times}\nm 0.001\ng 500\ndump "{dump}"')
    return dump


def on_the_way(file: Path, shares: tuple[float, ...] = (0.2, 0.5, 0.8)) -> list[Path]:
    """Stop the gradient descent after shares of the decrease of the energy, and return the files."""
    printed = run_evolver(file, f"{_MOVE}\ng\nprint total_energy\ng 6000\nprint total_energy")
    first, last = (float(x) for x in re.findall(r"^\s*([\d.]+)\s*$", printed, re.MULTILINE)[-2:])
    script, dumps = [f"{_MOVE}\ng"], []
    for share in shares:
        dumps.append(file.with_name(f"{file.stem}-{share:.0%}.dmp"))
        goal = first - share * (first - last)
        script.append(f"while total_energy > {goal:.9g} do g 1")
        script.append(f'dump "{dumps[-1]}"')
    run_evolver(file, "\n".join(script))
    return dumps
