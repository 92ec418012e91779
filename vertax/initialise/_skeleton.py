"""Labels from images of cell outlines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Int, Shaped
from scipy.ndimage import label


def labels_from_skeleton(
    image: Shaped[np.ndarray | Array, " *shape"],
) -> Int[np.ndarray, "rows columns"]:
    """Label image of the cells that lines enclose.

    Each region within lines (connected through the sides of pixels) is a cell. Regions that reach the
    border of the image are outside, label 0, and so are the lines; lines along the border are taken
    for a frame and do not count. Goes well with `from_labels(…, boundary="free")`.

    **Arguments:**

    - `image`: shape (rows, columns), 0 but on the lines.

    **Returns:** labels from 1, row by row.

    **Raises:**

    - `ValueError` for an image that is not two-dimensional or too small, holds no finite real numbers, or
        has lines that enclose nothing.
    """
    pixels = np.asarray(image)
    if pixels.dtype.kind not in "buif":
        raise ValueError(
            f"Argument `image` must hold real numbers, but its dtype is {pixels.dtype}."
        )
    if not np.isfinite(pixels).all():
        raise ValueError("Argument `image` must be finite, but holds NaN or infinity.")
    lines = pixels != 0
    if lines.ndim != 2 or min(lines.shape) < 3:
        raise ValueError(
            "Argument `image` must have shape (rows, columns), at least 3 × 3, but its shape is "
            f"{lines.shape}."
        )
    # The image is surrounded by outside, so a frame of lines encloses nothing.
    lines = np.pad(lines[1:-1, 1:-1], 1)
    regions = np.zeros(lines.shape, np.int32)
    label(~lines, output=regions)
    regions[regions == regions[0, 0]] = 0
    if not regions.any():
        raise ValueError("Argument `image` must show closed lines, but they enclose nothing.")
    return np.unique(regions, return_inverse=True)[1].reshape(regions.shape)
