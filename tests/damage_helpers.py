"""Label images of random cells, and the damage that masks have in practice."""

from typing import Any

import numpy as np
from label_helpers import rasterise
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree


def random_cells(rng: np.random.Generator) -> np.ndarray:
    """The label image of a disc of cells of random sizes: a Voronoi diagram after a few Lloyd steps."""
    cell, n = rng.uniform(22, 45), int(rng.integers(14, 45))
    side = int(cell * np.sqrt(n) * 1.1)
    seeds = rng.random((n, 2)) * side
    for _ in range(int(rng.integers(1, 4))):
        mask = rasterise(seeds, (side, side), periodic=False)
        y, x = np.indices(mask.shape) + 0.5
        count = np.maximum(np.bincount(mask.ravel(), minlength=n + 1)[1:], 1)
        seeds = np.stack(
            [np.bincount(mask.ravel(), z.ravel(), n + 1)[1:] / count for z in (x, y)], axis=1
        )
    mask = np.pad(rasterise(seeds, (side, side), periodic=False), 12)
    if (
        rng.random() < 0.5
    ):  # a cluster in a background; otherwise the border of the image cuts the cells
        middle = mask.shape[0] / 2
        y, x = np.indices(mask.shape) + 0.5
        inside = np.hypot(x - middle, y - middle) < 0.42 * side
        kept = np.flatnonzero(
            np.bincount(mask[inside], minlength=n + 1)
            > 0.5 * np.bincount(mask.ravel(), minlength=n + 1)
        )
        return np.where(np.isin(mask, kept), mask, 0)
    return mask[12:-12, 12:-12]


def contacts(mask: np.ndarray) -> set[tuple[int, int]]:
    """Pairs of labels that touch, by sides or corners of pixels."""
    pairs = set()
    height, width = mask.shape
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one = mask[: height - dy, max(0, -dx) : width - max(0, dx)]
        other = mask[dy:, max(0, dx) : width + min(0, dx)]
        differ = one != other
        pairs |= set(map(tuple, np.sort(np.stack([one, other], -1)[differ], axis=1).tolist()))
    return {pair for pair in pairs if pair[0] > 0}


def with_gaps(mask: np.ndarray, widths: np.ndarray | float) -> np.ndarray:
    """Lines without label between all cells, of one width or of a width for each pair of cells."""
    height, width = mask.shape
    # Sides between two cells lie between pixels: a grid of twice the resolution has a place for them.
    sides = np.zeros((2 * height - 1, 2 * width - 1), np.int64)
    n = int(mask.max()) + 1
    for place, one, other in (
        ((slice(1, None, 2), slice(None, None, 2)), mask[1:], mask[:-1]),
        ((slice(None, None, 2), slice(1, None, 2)), mask[:, 1:], mask[:, :-1]),
    ):
        touch = (one != other) & (one > 0) & (other > 0)
        sides[place] = np.where(touch, np.minimum(one, other) * n + np.maximum(one, other), 0)
    transform: Any = distance_transform_edt(sides == 0, return_indices=True)
    distance, nearest = transform
    pair = sides[tuple(nearest)][::2, ::2]
    width_of_pair = np.broadcast_to(np.asarray(widths, float), n * n)[pair]
    return np.where(distance[::2, ::2] / 2 < width_of_pair / 2, 0, mask)


def damaged(clean: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, float]]:
    """The mask with random damage, and the (height, width) of its pixels."""
    mask = clean.copy()
    labels = np.unique(mask[mask > 0])
    if rng.random() < 0.5:
        mask = np.where(np.isin(mask, rng.choice(labels, int(rng.integers(1, 4)))), 0, mask)
    if rng.random() < 0.6:
        widest, n_pairs = rng.uniform(1, 7), (int(mask.max()) + 1) ** 2
        mask = with_gaps(mask, rng.uniform(0, widest, n_pairs) if rng.random() < 0.5 else widest)
    if rng.random() < 0.5:
        mask = wrapped(mask, clean, rng)
    if rng.random() < 0.5:
        mask = with_specks(mask, rng)
    if rng.random() < 0.4:
        step = int(rng.integers(2, 4))
        if rng.random() < 0.5:
            return mask[:, ::step], (1.0, float(step))
        return mask[::step], (float(step), 1.0)
    return mask, (1.0, 1.0)


def wrapped(mask: np.ndarray, clean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The mask with one number for a few pairs of cells that do not touch."""
    labels, touching = np.unique(clean[clean > 0]), contacts(clean)
    for _ in range(int(rng.integers(1, 4))):
        a, b = sorted(rng.choice(labels, 2, replace=False).tolist())
        if (a, b) not in touching:
            mask = np.where(mask == b, a, mask)
            labels = labels[(labels != a) & (labels != b)]
    return mask


def with_specks(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The mask with small discs of labels of other cells, of new labels, and of none."""
    mask = mask.copy()
    tree = KDTree(np.argwhere(mask >= 0))
    rows = np.asarray(tree.data)
    for k in range(int(rng.integers(1, 12))):
        centre = rows[int(rng.integers(len(rows)))]
        disc = tree.query_ball_point(centre, rng.uniform(0.5, 3.0))
        label = rng.choice([0, int(mask.max()) + 1 + k, int(rng.choice(mask.ravel()))])
        mask[tuple(rows[disc].astype(int).T)] = label
    return mask
