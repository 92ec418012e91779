"""Tissues from microscopy images."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Int, Shaped

from vertax._base.checks import check_concrete
from vertax.initialise._labels import Segmentation, from_labels
from vertax.initialise._mask_arguments import check_options, check_zero
from vertax.initialise._segmenters import Segmenter, Watershed, check_image
from vertax.surfaces import AbstractSurface


def from_microscopy(
    image: Shaped[np.ndarray | Array, " *shape"],
    *,
    segmenter: Segmenter | None = None,
    boundary: str = "mirrored",
    pixel_size: float | None = None,
    softening: float | None = None,
    height: AbstractSurface | Shaped[np.ndarray | Array, "..."] | None = None,
    plane_distance: float = 1.0,
    unknown_height: float | int | None = None,
) -> Segmentation:
    """Tissue seen in a membrane image.

    It is segmented, and then handed to [`from_labels`][vertax.initialise.from_labels].

    The paper mirrors the image and then segments it (Methods, "Mesh initialization"); here it is
    segmented once and the labels are mirrored, which is the same with a symmetric segmenter, and
    makes the tissue symmetric with any.

    **Arguments:**

    - `image`: intensities of shape (rows, columns), e.g. from
        [`vertax.io.read_image`][vertax.io.read_image].
    - `segmenter`: [`Watershed`][vertax.initialise.Watershed] by default, or
        [`Cellpose`][vertax.initialise.Cellpose], or a custom one: a function from pixels to labels.
    - `boundary`, `pixel_size`, `softening`, `height`, `plane_distance`, `unknown_height`: as for
        `from_labels`. With `boundary="periodic"` cells are found across the border of the image.

    **Returns:** a [`Segmentation`][vertax.initialise.Segmentation].

    **Raises:**

    - `ValueError` for an image that is not a 2-D array of finite numbers, is smaller than 16 × 16
        or constant; for a segmenter that returns something else than an integer for each pixel, or
        finds fewer than two cells; and as `from_labels` does.
    - `ImportError` if what the segmenter needs is not installed.
    """
    check_concrete("from_microscopy", image, pixel_size)
    check_options(boundary, pixel_size)
    pixels = check_image(image)
    segmenter = Watershed() if segmenter is None else segmenter
    if not callable(segmenter) or isinstance(segmenter, type):
        raise TypeError(
            "Argument `segmenter` must be a segmenter, such as Watershed(), or a function from an image to "
            f"its labels, but is {segmenter!r}."
        )
    segment = _segment_periodic if boundary == "periodic" else _segment
    labels = segment(pixels, segmenter)
    n_cells = len(np.unique(labels[labels > 0]))
    if n_cells < 2:
        raise ValueError(
            f"Argument `image` must show at least two cells, but {_name(segmenter)} found "
            f"{n_cells}. Check that membranes are bright on dark cells, and that the segmenter "
            "knows the size of the cells."
        )
    curved = {"height": height, "plane_distance": plane_distance, "unknown_height": unknown_height}
    options: dict[str, Any] = {
        "boundary": boundary,
        "pixel_size": pixel_size,
        "softening": softening,
    }
    try:
        return from_labels(labels, **options, **curved)
    except ValueError as error:
        raise ValueError(
            f"The labels that {_name(segmenter)} found in `image` make no tissue. {error}"
        ) from error


def _name(segmenter: Segmenter) -> str:
    """Its name in messages; a custom segmenter may be a function."""
    return getattr(segmenter, "__name__", type(segmenter).__name__)


def _segment(image: np.ndarray, segmenter: Segmenter) -> Int[np.ndarray, "rows columns"]:
    labels = np.asarray(segmenter(image))
    if labels.shape != image.shape or labels.dtype.kind not in "iu":
        raise ValueError(
            f"Argument `segmenter` must return an integer label for each pixel, shape "
            f"{image.shape}, but {_name(segmenter)} returned {labels.dtype} of shape "
            f"{labels.shape}."
        )
    return labels


def _segment_periodic(image: np.ndarray, segmenter: Segmenter) -> Int[np.ndarray, "rows columns"]:
    """Labels of a periodic image, with cells that cross its border whole.

    Every cell lies whole somewhere in the image continued by half of itself on all sides. There it
    has several copies; the one with its centre in the original is taken.
    """
    rows, columns = image.shape
    top, left = rows // 2, columns // 2
    labels = _segment(np.pad(image, ((top, top), (left, left)), mode="wrap"), segmenter)
    check_zero(f"{_name(segmenter)}(image)", labels, None)
    y, x = np.nonzero(labels > 0)
    label = labels[y, x].astype(np.int64)
    counts = np.maximum(np.bincount(label), 1)
    row, column = (np.bincount(label, z) / counts - z0 for z, z0 in ((y, top), (x, left)))
    home = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    keep = home[label]
    periodic = np.zeros(image.shape, labels.dtype)
    periodic[(y[keep] - top) % rows, (x[keep] - left) % columns] = label[keep]
    return periodic
