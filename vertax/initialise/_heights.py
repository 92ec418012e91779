"""The surface of a segmented tissue, from the heights of its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from vertax._base.checks import check_number, check_shape
from vertax._base.pixels import pixel_length, pixel_sides
from vertax.mesh import Periodic, geometry_of
from vertax.surfaces import AbstractSurface, HeightMap

# Smoothing of an image of heights, relative to the root of the median area of a cell: of a smooth one, and of
# steps of planes, which have fewer distinct values than this share of their pixels.
_SMOOTHING, _SMOOTHING_OF_STEPS, _STEPS = 0.25, 0.5, 0.01


def surface_of(
    source: Any,
    height: Any,
    plane_distance: float,
    unknown: float | int | None,
    *,
    sized: bool,
) -> AbstractSurface:
    """The surface below the tissue of a mask.

    **Arguments:**

    - `source`: the `Segmentation` of the mask.
    - `height`, `plane_distance`, `unknown`: as of `from_labels`.
    - `sized`: whether `plane_distance` has the unit of the tissue, or that of the side of a pixel.
    """
    if isinstance(height, AbstractSurface):
        return height
    check_number("plane_distance", plane_distance, above=0)
    heights, tissue = np.asarray(height), source.tissue
    check_shape(
        "height", heights, source.image_shape, remedy="Pass the height of each pixel of the mask."
    )
    pixel = pixel_length(source.pixel_size)
    stepped = len(np.unique(heights)) < _STEPS * heights.size
    width = _SMOOTHING_OF_STEPS if stepped else _SMOOTHING
    areas = np.abs(geometry_of(tissue).areas)[source.labels > 0]
    if isinstance(tissue.boundary, Periodic):
        box = np.diag(np.asarray(tissue.boundary.lattice)) / pixel_sides(source.pixel_size)
        rest = np.rint(box[::-1]).astype(int) - heights.shape  # of a mirrored mask, its size
        heights = np.pad(heights, [(0, n) for n in rest.tolist()], mode="symmetric")
    return HeightMap(
        heights,
        source.pixel_size,
        plane_distance=plane_distance * (1.0 if sized else pixel),
        smoothing=max(pixel, width * float(np.sqrt(np.median(areas)))),
        unknown=float("nan" if unknown is None else unknown),
        periodic=isinstance(tissue.boundary, Periodic),
    )
