"""Pixels without a label: gaps between cells, holes, and the exterior of a free tissue."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, label as connected_regions, maximum

GAP, EXTERIOR, FIRST_HOLE = -1, -2, -3
# Smallest default of `gap_width`, and largest relative to the size of a cell.
_LEAST_WIDTH, _LARGEST_WIDTH = 3.0, 0.3
# Quantile over the pairs of neighbours of the distance between them.
_QUANTILE = 0.9


class FilledGaps(NamedTuple):
    """A label image without gaps, in a margin of exterior."""

    image: Int[np.ndarray, "padded_rows padded_columns"]
    """Labels, EXTERIOR, and FIRST_HOLE - k in the k-th hole."""
    margin: int
    """Width of the margin in pixels."""


def fill_gaps(
    image: Int[np.ndarray, "rows columns"],
    *,
    periodic: bool = False,
    spacing: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Give each gap the nearest label."""
    gap = image == GAP
    return image[nearest_outside(gap, spacing, periodic=periodic)[1]] if gap.any() else image


def line_width(
    image: Int[np.ndarray, "rows columns"], spacing: tuple[float, float]
) -> tuple[float, float]:
    """Width of the gaps between neighbouring labels, in the shorter side of a pixel.

    Gaps are filled with the nearest label. The width of a gap at a side between two filled pixels of
    different labels is the sum of their distances from their labels; that of a pair of labels is the median
    along their interface.

    **Returns:** the 0.9 quantile over all pairs at most 0.3 cell sizes apart, and the median over all pairs.
    """
    if not np.any(image == GAP):
        return 0.0, 0.0
    distance, nearest = nearest_outside(image == GAP, spacing)
    filled = image[nearest]
    first, second, width = [], [], []
    for one, other in _PAIRS:
        differ = filled[one] != filled[other]
        first.append(np.minimum(filled[one], filled[other])[differ])
        second.append(np.maximum(filled[one], filled[other])[differ])
        width.append((distance[one] + distance[other])[differ])
    width = np.concatenate(width)
    if not len(width):
        return 0.0, 0.0
    pair = np.concatenate(first).astype(np.int64) * (int(filled.max()) + 1) + np.concatenate(second)
    sizes = np.bincount(image[image >= 0])
    cell = np.sqrt(np.median(sizes[sizes > 0]) * np.prod(spacing))
    near = width < _LARGEST_WIDTH * cell
    every = _medians(pair, width)
    close = _medians(pair[near], width[near])
    return (float(np.quantile(close, _QUANTILE)) if len(close) else 0.0), float(np.median(every))


def nearest_outside(
    region: Bool[np.ndarray, "rows columns"],
    spacing: tuple[float, float],
    *,
    periodic: bool = False,
) -> tuple[Float[np.ndarray, "rows columns"], tuple[np.ndarray, np.ndarray]]:
    """Distance of each pixel from the nearest one outside a region, and the index of that pixel."""
    transform: Any = distance_transform_edt(region, spacing, return_indices=True)
    distance, (y, x) = transform
    if not periodic:
        return distance, (y, x)
    # The nearest pixel on the torus is at most as far as the nearest one in the image.
    rows, columns = region.shape
    top, left = np.minimum(np.ceil(np.max(distance) / np.array(spacing)), region.shape).astype(int)
    wrapped = np.pad(region, [(top, top), (left, left)], mode="wrap")
    transform = distance_transform_edt(wrapped, spacing, return_indices=True)
    home = (slice(top, top + rows), slice(left, left + columns))
    distance, (y, x) = transform[0][home], (index[home] for index in transform[1])
    return distance, ((y - top) % rows, (x - left) % columns)


_PAIRS = (
    ((slice(None), slice(1, None)), (slice(None), slice(-1))),
    ((slice(1, None),), (slice(-1),)),
)


def _medians(
    group: Int[np.ndarray, " sides"], value: Float[np.ndarray, " sides"]
) -> Float[np.ndarray, " groups"]:
    """The median of the values of each group."""
    order = np.lexsort((value, group))
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    count = np.diff(np.append(first, len(order)))
    return value[order][first + count // 2]


def default_gap_width(measured: float) -> float:
    """The default of `gap_width` for lines of a measured width."""
    return max(_LEAST_WIDTH, float(np.ceil(measured)) + 1.0)


def reach_of(gap_width: float) -> float:
    """Largest distance from a label, in pixels, in a gap that is closed."""
    # In the middle of a line of n pixels the distance to the nearest label is (n + 1) / 2.
    return (gap_width + 1) / 2


def least_hole_radius(gap_width: float) -> float:
    """Distance from the nearest label, in pixels, that the middle of a hole exceeds."""
    # Where four lines of width w meet at right angles, their middle is w / √2 from the nearest label.
    return 1.5 * reach_of(gap_width) + 1.0


def with_exterior(
    image: Int[np.ndarray, "rows columns"],
    gap_width: float,
    spacing: tuple[float, float],
    *,
    keep_holes: bool,
) -> FilledGaps:
    """The image in a margin, each gap given to the exterior, to a hole or to the nearest label.

    1. *Wide* pixels are farther than `reach_of(gap_width)` from all labels. Their connected regions are the
       exterior (the region of the margin) and holes (deeper than `least_hole_radius`).
    2. Both regain the rim of the width of the reach around them.
    3. All other gaps go to the nearest label.
    """
    reach = reach_of(gap_width)
    margin = int(np.ceil(2 * reach / min(spacing))) + 2
    image = np.pad(image, margin, constant_values=GAP)
    gap = image == GAP
    distance = np.asarray(distance_transform_edt(gap, spacing))
    regions = np.zeros(image.shape, np.int32)
    n_regions: Any = connected_regions(distance > reach, output=regions)
    code = np.full(n_regions + 1, GAP, image.dtype)
    if keep_holes:
        deep = np.asarray(maximum(distance, regions, np.arange(n_regions + 1)))
        deep = deep > least_hole_radius(gap_width)
        deep[[0, regions[0, 0]]] = False
        code[deep] = FIRST_HOLE - np.arange(np.count_nonzero(deep))
    code[regions[0, 0]] = EXTERIOR
    code[0] = GAP
    open_region = code[regions]
    away, nearest = nearest_outside(open_region == GAP, spacing)
    near = gap & (away <= reach)
    return FilledGaps(
        fill_gaps(np.where(near, open_region[nearest], image), spacing=spacing), margin
    )


def largest_cluster(
    image: Int[np.ndarray, "rows columns"], exterior: int
) -> Int[np.ndarray, "rows columns"]:
    """The image in which all clusters except the one of most pixels are exterior."""
    cluster = np.zeros(image.shape, np.int32)
    connected_regions(image != exterior, output=cluster)
    sizes = np.bincount(cluster.ravel())
    sizes[0] = 0
    return np.where(cluster == np.argmax(sizes), image, exterior)
