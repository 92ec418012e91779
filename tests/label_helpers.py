"""Label images to make tissues from, and what to compare of the tissues."""

import numpy as np
from scipy.spatial import KDTree

from vertax import Periodic, Tissue
from vertax.initialise import Segmentation, from_labels, periodic_voronoi

SHAPE = (120, 160)


def rasterise(seeds: np.ndarray, shape: tuple[int, int], periodic: bool = True) -> np.ndarray:
    """Label image of the Voronoi cells of `seeds` (x, y in pixels), labels from 1."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    tree = KDTree(seeds, boxsize=shape[::-1] if periodic else None)
    nearest = np.asarray(tree.query(np.stack([x.ravel(), y.ravel()], 1))[1])
    return nearest.reshape(shape) + 1


def clear_seeds(n: int, shape: tuple[int, int], seed: int) -> np.ndarray:
    """Seeds of cells with edges longer than 3 pixels."""
    box = np.diag(np.array(shape[::-1], float))
    rng = np.random.default_rng(seed)
    while True:
        points = rng.random((n, 2)) @ box
        for _ in range(4):
            tissue = periodic_voronoi(seeds=points, lattice=box, softening=0.0)
            if tissue.edge_lengths.min() > 3:
                return points
            points = np.asarray(tissue.centroids) % np.diag(box)


def make(mask: np.ndarray, boundary: str = "periodic") -> Segmentation:
    """A tissue in pixels. (A given softening saves compiling the default for every new shape.)"""
    return from_labels(mask, boundary=boundary, pixel_size=1.0, softening=0.0)


def sides(tissue: Tissue) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of each half-edge, in NumPy: JAX would compile for every new shape."""
    m = tissue.topology
    assert isinstance(tissue.boundary, Periodic)
    frame = np.asarray(m.frame) @ np.asarray(tissue.boundary.lattice)
    corners = np.repeat(np.asarray(tissue.vertices), 3, axis=0) + frame
    twin = np.asarray(m.twin)
    return corners, corners[3 * (twin // 3) + (twin + 2) % 3]


def areas_of(tissue: Tissue) -> np.ndarray:
    """Shoelace areas."""
    (x, y), (u, v) = (ends.T for ends in sides(tissue))
    return 0.5 * np.bincount(np.asarray(tissue.topology.cell), x * v - y * u)


def sides_of(tissue: Tissue) -> np.ndarray:
    return np.bincount(np.asarray(tissue.topology.cell))


def neighbours(tissue: Tissue, names: np.ndarray) -> list[tuple[int, int]]:
    """The pair of cells at each edge, sorted."""
    m = tissue.topology
    one = np.asarray(m.half_edge)
    cell = names[np.asarray(m.cell)]
    pairs = np.sort(np.stack([cell[one], cell[np.asarray(m.twin)[one]]], axis=1), axis=1)
    return sorted(map(tuple, pairs.tolist()))


def touching_pairs(mask: np.ndarray) -> set[tuple[int, int]]:
    """Labels that share a pixel side in a periodic mask, pixel by pixel."""
    pairs = set()
    for shifted in (np.roll(mask, 1, 0), np.roll(mask, 1, 1)):
        pairs |= {(min(a, b), max(a, b)) for a, b in zip(mask.flat, shifted.flat, strict=True)}
    return {(int(a), int(b)) for a, b in pairs if a != b}


def polygon(segmentation: Segmentation, label: int) -> np.ndarray:
    """Corners, in pixels, of the first cell with a label."""
    m = segmentation.tissue.topology
    cell = int(np.flatnonzero(segmentation.labels == label)[0])
    h = int(np.flatnonzero(np.asarray(m.cell) == cell)[0])
    sides = [h]
    while (h := int(m.next[h])) != sides[0]:
        sides.append(h)
    return np.asarray(segmentation.tissue.corners)[sides] / segmentation.pixel_size


def honeycomb() -> np.ndarray:
    """30 cells in brick rows, each with six neighbours around the torus."""
    rows = [np.roll(np.repeat(np.arange(5) + 5 * r + 1, 10), 5 * (r % 2)) for r in range(6)]
    return np.repeat(np.array(rows), 10, axis=0)
