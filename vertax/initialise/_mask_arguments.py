"""Which labels of a mask are cells: checks of the arguments of `from_labels`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Int, Integer, Shaped
from scipy.ndimage import label as connected_regions

from vertax._base.checks import check_choice, check_integer
from vertax._base.pixels import PixelSize, check_pixel_size, without_single_axes
from vertax.initialise._pieces import connected_pieces

# A picture has at least this number of connected regions, more than half of its pixels in regions of fewer
# pixels than this, and less than this share of its pixels in the largest region of each label.
_PICTURE_PIECES, _SMALL_PIXELS, _PICTURE_SHARE = 100, 25, 0.25
# Lines have at least this share of all sides between pixels of different labels, and are thinner than this,
# relative to the root of the median area of the regions between them.
_LINE_SHARE, _LINE_WIDTH = 0.75, 0.3
# Smallest number of regions between lines.
_LINE_CELLS = 6

_BOUNDARIES = ("mirrored", "periodic", "free")


def check_options(boundary: str, pixel_size: PixelSize | None) -> None:
    """Raise a `ValueError` for an unknown boundary or an impossible pixel size."""
    check_choice("boundary", boundary, _BOUNDARIES)
    if pixel_size is not None:
        check_pixel_size("pixel_size", pixel_size)


def checked_mask(
    mask: Shaped[np.ndarray | Array, " *shape"], background: int | None
) -> tuple[Int[np.ndarray, " labels"], Int[np.ndarray, "rows columns"], int | None]:
    """The labels in ascending order, the mask with each replaced by its rank, and the background.

    Gaps are -1.
    """
    # Of a masked array, what is masked is no cell.
    mask = np.ma.filled(mask, 0) if isinstance(mask, np.ma.MaskedArray) else np.asarray(mask)
    mask = without_single_axes(mask)
    if mask.ndim != 2 or mask.size == 0:
        raise ValueError(
            "Argument `mask` must have shape (rows, columns), one label a pixel, but its shape is "
            f"{mask.shape}. Pass one plane of a stack, such as mask[0], without a channel axis."
        )
    if mask.dtype.kind not in "iu":
        convert = "mask.astype(int)"
        if mask.dtype.kind == "f" and np.isnan(mask).any():
            convert = "numpy.nan_to_num(mask, nan=0), where NaN is no cell, and mask.astype(int)"
        raise ValueError(
            f"Argument `mask` must hold integer labels, but its dtype is {mask.dtype}. Number the "
            "cells (scipy.ndimage.label does it for a binary mask) or convert the labels with "
            f"{convert}."
        )
    check_bits("mask", mask)
    check_zero("mask", mask, background)
    background = _background(mask, background)
    if background is not None:
        mask = np.where(mask == background, 0, mask)
    check_no_picture("mask", mask)
    lines = _label_of_lines(mask)
    if lines is not None:
        mask = np.where(mask == lines, 0, mask)
        background = lines if background is None else background
    values, image = np.unique(mask, return_inverse=True)
    n_gaps = int(np.count_nonzero(values <= 0))
    values = values[n_gaps:]
    if len(values) < 2:
        but = f"holds {len(values)}"
        if background is not None:
            but += f" besides the background, {background}"
        raise ValueError(
            "Argument `mask` must hold at least two cells, labelled by positive integers, but "
            f"{but}: every cell needs its own label."
        )
    image = image.reshape(mask.shape).astype(np.int32) - n_gaps
    return values.astype(np.int64), np.maximum(image, -1), background


def check_bits(name: str, mask: Integer[np.ndarray, "rows columns"]) -> None:
    """Raise a `ValueError` for labels that are no signed integers of 64 bits."""
    if mask.max() > np.iinfo(np.int64).max:
        raise ValueError(
            f"Argument `{name}` must hold labels of at most 63 bits, but its largest is "
            f"{mask.max()}. Number the cells anew: numpy.unique({name}, return_inverse=True)[1]."
        )


def check_no_picture(name: str, mask: Integer[np.ndarray, "rows columns"]) -> None:
    """Raise a `ValueError` for a picture: its grey values are no labels of cells."""
    pieces = connected_pieces(mask, periodic=False)
    is_label = pieces.value > 0
    size = pieces.size[is_label]
    labels, index = np.unique(pieces.value[is_label], return_inverse=True)
    largest = np.zeros(len(labels), int)
    np.maximum.at(largest, index, size)
    # Of 16 bits, most labels of a picture have one pixel.
    in_cells = largest[largest > 3].sum()
    small = size[size < _SMALL_PIXELS].sum()
    if (
        len(size) < _PICTURE_PIECES
        or 2 * small < size.sum()
        or in_cells > _PICTURE_SHARE * size.sum()
    ):
        return
    raise ValueError(
        f"Argument `{name}` must hold a label for each cell, but has {len(labels)} labels in {len(size)} "
        f"pieces of median {np.median(size):.0f} pixel: a picture, not a mask. Segment the picture first; "
        "or, if this is a mask that was resized, resize it without interpolation (order 0). Grey outlines on "
        "0: pass vx.initialise.labels_from_skeleton(mask), or kind='outlines' to vx.tensions."
    )


def check_zero(
    name: str, mask: Integer[np.ndarray, "rows columns"], background: int | None
) -> None:
    """Raise an error where 0 may be the label of a cell: where another label of what is no cell is below it.

    **Arguments:**

    - `name`: of the argument, for the message.
    - `mask`: the labels.
    - `background`: the label of what is no cell, if it was given.

    **Raises:**

    - `ValueError` for 0 beside negative labels, unless `background` is 0; and beside a background that is the
        largest number of an unsigned type, which is -1 wrapped around.
    """
    if background == 0 or not np.any(mask == 0):
        return
    other, not_a_cell = mask.min(), f"background=0 or numpy.maximum({name}, 0)"
    if other >= 0:
        other = np.iinfo(mask.dtype).max if mask.dtype.kind == "u" else 0
        not_a_cell = f"numpy.where({name} == {other}, 0, {name})"
        if other == 0 or _background(mask, background) != other:
            return
    raise ValueError(
        f"Argument `{name}` must have positive labels for cells, but has the label 0 beside {other}, which "
        f"is no cell. If 0 is a cell, pass {name} + 1; if it is none, {not_a_cell}."
    )


def _background(mask: Integer[np.ndarray, "rows columns"], given: int | None) -> int | None:
    """The positive label of what is no cell."""
    if given is not None:
        check_integer("background", given)
        if not np.any(mask == given):
            raise ValueError(
                f"Argument `background` must be a label of the mask, but no pixel has {given}."
            )
        return int(given) if given > 0 else None
    # All others lie within a label that has the whole border, and a cell around all others is none.
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    label = int(border[0])
    alone = label <= 0 or np.any(border != label) or np.all((mask == label) | (mask <= 0))
    return None if alone else label


def _label_of_lines(mask: Integer[np.ndarray, "rows columns"]) -> int | None:
    """The positive label of lines that separate all cells."""
    pairs = [(mask[:, 1:], mask[:, :-1]), (mask[1:], mask[:-1])]
    first, second = np.concatenate(
        [np.stack([a, b])[:, (a != b) & (a > 0) & (b > 0)] for a, b in pairs], axis=1
    )
    labels, n_sides = np.unique(np.append(first, second), return_counts=True)
    if not len(labels) or n_sides.max() < _LINE_SHARE * len(first):
        return None
    line = labels[np.argmax(n_sides)]
    regions = np.zeros(mask.shape, np.int32)
    n_cells: Any = connected_regions((mask != line) & (mask > 0), output=regions)
    if n_cells < _LINE_CELLS:
        return None
    # A line of width w has two sides for w pixels.
    width = 2 * np.count_nonzero(mask == line) / n_sides.max()
    cell = np.sqrt(np.median(np.bincount(regions.ravel())[1:]))
    return int(line) if width < _LINE_WIDTH * cell else None
