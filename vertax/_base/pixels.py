"""Sizes of pixels: one number for square pixels, or (height, width)."""

from __future__ import annotations

from typing import Any, SupportsFloat, TypeAlias

import numpy as np
from jaxtyping import Float

from vertax._base.checks import check_number

PixelSize: TypeAlias = float | tuple[float, float]
PixelSizeLike: TypeAlias = SupportsFloat | tuple[SupportsFloat, SupportsFloat]


def check_pixel_size(name: str, value: Any) -> None:
    """Raise an error unless a value is a positive number or a pair of them.

    **Arguments:**

    - `name`: name of the argument, for the message.
    - `value`: length of the side of a pixel, or height and width.

    **Raises:**

    - `TypeError` for a value that is not a real number.
    - `ValueError` for a number that is not positive, or an array of another shape.
    """
    pair = np.ndim(value) == 1 and len(value) == 2
    if np.ndim(value) and not pair:
        raise ValueError(
            f"Argument `{name}` must be one number or (height, width) of a pixel, but has the shape "
            f"{np.shape(value)}."
        )
    for side in value if pair else (value,):
        check_number(name, side, above=0)


def pixel_sides(pixel_size: Any) -> Float[np.ndarray, " xy"]:
    """Width and height of a pixel: along x (columns) and along y (rows).

    **Arguments:**

    - `pixel_size`: length of the side of a pixel, or height and width.

    **Returns:** (width, height).
    """
    height, width = np.broadcast_to(np.asarray(pixel_size, float), 2).tolist()
    return np.array([width, height])


def as_pixel_size(sides: Float[np.ndarray, " xy"]) -> PixelSize:
    """The inverse of [`pixel_sides`][vertax._base.pixels.pixel_sides]: one number if both are equal.

    **Arguments:**

    - `sides`: (width, height).

    **Returns:** a number, or (height, width).
    """
    width, height = sides.tolist()
    return width if width == height else (height, width)


def pixel_length(pixel_size: Any) -> float:
    """Side of the square of the area of a pixel.

    **Arguments:**

    - `pixel_size`: length of the side of a pixel, or height and width.

    **Returns:** the length.
    """
    return float(np.sqrt(np.prod(pixel_sides(pixel_size))))


def without_single_axes(image: np.ndarray) -> np.ndarray:
    """An image without the axes of length 1 that a third and further axes are."""
    while image.ndim > 2 and 1 in image.shape:
        image = np.squeeze(image, axis=image.shape.index(1))
    return image
