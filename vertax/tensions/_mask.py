"""Label images from arrays and files of segmentations."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from scipy.ndimage import distance_transform_edt, label

from vertax._base.checks import check_choice, check_integer
from vertax._base.pixels import without_single_axes
from vertax.initialise._mask_arguments import (
    check_bits,
    check_no_picture,
    check_zero,
)
from vertax.initialise._pieces import connected_pieces
from vertax.io._image import read_colours

# A region at the border of the image that is larger than this, relative to the median cell, is no cell.
_OUTSIDE = 5.0
# A region smaller than this, relative to the median cell, is no cell either.
_SPECK = 0.03
# Largest width of lines, relative to the size of a cell.
_THIN = 0.3


def read_mask(
    mask: Shaped[np.ndarray | Array, "..."] | str | os.PathLike[str],
    *,
    kind: str = "auto",
    background: int | None = None,
    plane: int | None = None,
) -> Int[np.ndarray, "rows columns"]:
    """A label for each pixel, from a label image or an image of outlines.

    - **Labels**: integers, or a colour for each cell; also `NAME_seg.npy` of Cellpose. In a file with a
        palette the indices are the labels, if index 0 is black or colours repeat.
    - **Outlines**: two values, as of Tissue Analyzer, EPySeg and skeletons, and of boolean masks of cells
        with lines between them; grey or in colours, of any thickness, connected by sides or by corners of
        pixels. The rarer value is the line, or the other one where that makes no cells. Each region within
        lines is a cell, and the lines go half to each of their sides. A region at the border of the image
        is a cell that the border cuts; but one that has most of the border, or is much larger than cells,
        is outside.

    **Arguments:**

    - `mask`: the pixels, shape (rows, columns) or (rows, columns, colours), with `plane` also (planes, rows,
        columns); or a file: TIFF, PNG, NPY. Axes of length 1 are dropped. NaN is no cell.
    - `kind`: `"labels"`, `"outlines"`, or `"auto"`: outlines if there are two values or colours.
    - `background`: the label of what is no cell, if it is not 0. Labels of cells are positive.
    - `plane`: of a stack, the plane (a frame, a depth) to take, from 0.

    **Returns:** the labels, 0 where there is no cell. See [`from_labels`][vertax.initialise.from_labels].

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` for an unknown `kind`, pixels of another shape, labels that are not whole numbers or too
        large for their type, a stack without `plane`, a `background` that no pixel has, labels of which 0 may
        be that of a cell (0 and negative ones), a picture in place of labels, outlines that enclose less than
        two cells, and two values of which neither is a line thinner than a third of a cell, unless `kind` is
        `"outlines"`.
    """
    return labels_and_lines(mask, kind, background, plane)[0]


def labels_and_lines(
    mask: Shaped[np.ndarray | Array, "..."] | str | os.PathLike[str],
    kind: str,
    background: int | None,
    plane: int | None,
) -> tuple[Int[np.ndarray, "rows columns"], float]:
    """The labels of [`read_mask`][vertax.tensions.read_mask], and the width of the lines in pixels, or 0."""
    check_choice("kind", kind, ("auto", "labels", "outlines"))
    if plane is not None:
        check_integer("plane", plane, at_least=0)
    if isinstance(mask, str | os.PathLike):
        pixels = _loaded(Path(mask), plane)
    else:
        pixels = np.ma.filled(mask, 0) if isinstance(mask, np.ma.MaskedArray) else mask
        pixels = _one_plane(np.asarray(pixels), plane)
    values = _numbered(pixels)
    if background is not None:
        if not np.any(values == background):
            raise ValueError(
                f"Argument `background` must be a label of the mask, but no pixel has {background}."
            )
        values = np.where(values == background, 0, values)
    colours, counts = np.unique(values, return_counts=True)
    if kind == "outlines" or (kind == "auto" and len(colours) == 2):
        if len(colours) < 2:
            raise ValueError("Argument `mask` must show lines, but all its pixels are alike.")
        lines = [values != 0]
        if len(colours) == 2:
            lines = [values == colour for colour in colours[np.argsort(counts, kind="stable")]]
        # Two labels without background that fill the image enclose nothing, and are two cells.
        labels_only = kind == "auto" and len(colours) == 2 and bool(colours[0] > 0)
        outlined = _outlined(lines, check_width=kind == "auto", may_fail=labels_only)
        if outlined is not None:
            return outlined.labels, outlined.line_width
    if pixels.ndim == 2 and pixels.dtype.kind in "iu":
        check_zero("mask", pixels, background)
    check_no_picture("mask", values)
    return np.maximum(values, 0), 0.0


def planes_of(pixels: np.ndarray) -> np.ndarray:
    """The planes of an array without axes of length 1; a last axis of 3 or 4 is one of colours."""
    pixels = without_single_axes(pixels)
    if pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4)):
        return pixels[None]
    return pixels.reshape(-1, *pixels.shape[-2:])


def _one_plane(pixels: np.ndarray, plane: int | None) -> np.ndarray:
    """The chosen plane of an array; a `ValueError` for a stack without a choice, or without this plane."""
    planes = planes_of(pixels)
    if plane is None and len(planes) != 1:
        raise ValueError(
            "Argument `mask` must have shape (rows, columns), or a third axis of colours, but its shape "
            f"is {pixels.shape}, a stack of {len(planes)} planes. Pass one plane of a stack, by the "
            f"argument `plane`, 0 … {len(planes) - 1}."
        )
    if (plane or 0) >= len(planes):
        raise ValueError(
            f"Argument `plane` must lie in 0 … {len(planes) - 1} for an image of shape {pixels.shape}, but "
            f"is {plane}."
        )
    return planes[plane or 0]


def _loaded(file: Path, plane: int | None) -> np.ndarray:
    pixels = read_pixels(file, "mask", partial(read_colours, plane=plane))
    return _one_plane(pixels, plane) if file.suffix.lower() == ".npy" else pixels


def read_pixels(file: Path, name: str, read: Callable[[Path], np.ndarray]) -> np.ndarray:
    """The array in a file of NumPy or Cellpose, or that of another reader; errors name the argument."""
    if not file.exists():
        raise FileNotFoundError(f"Argument `{name}` must name a file, but {file} does not exist.")
    if file.suffix.lower() != ".npy":
        try:
            return read(file)
        except ValueError as error:
            raise ValueError(str(error).replace("`path`", f"`{name}`")) from error
    # Cellpose saves a dictionary, which only pickles hold; masks are plain arrays.
    of_cellpose = file.name.endswith("_seg.npy")
    try:
        content = np.load(file, allow_pickle=of_cellpose)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(
            f"Argument `{name}` must name a file of `numpy.save` with an array of numbers, but {file} cannot "
            "be read as one."
        ) from error
    if not of_cellpose:
        return content
    content = content.item() if content.dtype == object and content.ndim == 0 else {}
    if not isinstance(content, dict) or "masks" not in content:
        raise ValueError(f"{file} must hold `masks`, as Cellpose saves them, but does not.")
    return np.asarray(content["masks"])


def _numbered(pixels: Shaped[np.ndarray, "..."]) -> Int[np.ndarray, "rows columns"]:
    """Integers, one for each colour; black is 0."""
    if pixels.ndim == 3:
        pixels = pixels[..., :3]
        planes = [_ranks(plane) for plane in np.moveaxis(pixels, -1, 0)]
        number = _ranks(np.ravel_multi_index(planes, [int(plane.max()) + 1 for plane in planes]))
        if _are_frames(planes, int(number.max()) + 1):
            raise ValueError(
                "Argument `mask` must have shape (rows, columns), or a third axis of colours, but its last "
                f"axis holds {pixels.shape[2]} label images that differ. Label planes are not colours: pass "
                "one, such as mask[..., 0]."
            )
        return np.where(np.any(pixels, axis=-1), number + 1, 0)
    if pixels.ndim != 2 or pixels.size == 0:
        raise ValueError(
            "Argument `mask` must have shape (rows, columns), or a third axis of colours, but its shape is "
            f"{pixels.shape}."
        )
    if pixels.dtype.kind == "b":
        return pixels.astype(np.int64)
    if pixels.dtype.kind == "f":
        return _whole_numbers(pixels)
    if pixels.dtype.kind not in "iu":
        raise ValueError(f"Argument `mask` must hold numbers, but its dtype is {pixels.dtype}.")
    check_bits("mask", pixels)
    return pixels.astype(np.int64)


def _ranks(pixels: Shaped[np.ndarray, "rows columns"]) -> Int[np.ndarray, "rows columns"]:
    """The index of each pixel among the different values."""
    return np.unique(pixels, return_inverse=True)[1].reshape(pixels.shape)


def _are_frames(planes: Sequence[Int[np.ndarray, "rows columns"]], n_colours: int) -> bool:
    """Whether each plane is a label image, and together they divide the image into many more regions."""
    n_values = [int(plane.max()) + 1 for plane in planes]
    for plane, n in zip(planes, n_values, strict=True):
        sizes = connected_pieces(plane, periodic=False).size
        # (Stray pixels are no regions.)
        if n < 3 or np.sum(sizes > _SPECK * np.median(sizes)) > 1.5 * n:
            return False
    return n_colours > 1.5 * max(n_values)


def _whole_numbers(pixels: Float[np.ndarray, "rows columns"]) -> Int[np.ndarray, "rows columns"]:
    """Labels that were stored as floats; NaN becomes 0."""
    pixels = np.where(np.isnan(pixels), 0, pixels)
    if not np.isfinite(pixels).all() or np.any(pixels != np.rint(pixels)):
        raise ValueError(
            "Argument `mask` must hold whole numbers, a label for each pixel (or NaN), but holds "
            f"{pixels[~(np.isfinite(pixels) & (pixels == np.rint(pixels)))].flat[0]}. A grey image must be "
            "segmented first."
        )
    # Beyond, different labels may have been rounded to one.
    bits = np.finfo(pixels.dtype).nmant + 1
    largest = float(np.max(np.abs(pixels)))
    if largest > 2.0**bits:
        raise ValueError(
            f"Argument `mask` must hold labels of at most {bits} bits, as {pixels.dtype} holds exactly, but "
            f"its largest is {largest:.0f}. Save the labels as integers, numbered anew: "
            "numpy.unique(labels, return_inverse=True)[1]."
        )
    return pixels.astype(np.int64)


class _Outlined(NamedTuple):
    """Cells that lines separate."""

    labels: Int[np.ndarray, "rows columns"]
    line_width: float
    """Width of the lines in pixels: lower quartile along each interface, median over all."""
    cell_size: float
    """Root of the median area of a region, in pixels."""


def _outlined(
    candidates: Sequence[Bool[np.ndarray, "rows columns"]], *, check_width: bool, may_fail: bool
) -> _Outlined | None:
    """Labels of the cells between lines, for the first of the candidates for the lines that encloses cells.

    None if none does and `may_fail`.

    **Raises:**

    - `ValueError` if none has at least two regions; with `check_width` also if no lines are thinner than
        the cells.
    """
    regions = [_between(lines) for lines in candidates]
    outlined = [each for each in regions if isinstance(each, _Outlined)]
    if not outlined and may_fail:
        return None
    if not outlined:
        raise ValueError(
            "Argument `mask` must show lines that enclose cells, but they enclose "
            f"{'one region' if any(regions) else 'nothing'}: are they closed?"
        )
    thin = [each for each in outlined if each.line_width < _THIN * each.cell_size]
    if check_width and not thin:
        if may_fail:
            return None
        first = outlined[0]
        raise ValueError(
            "Argument `mask` must hold labels, or lines that are thinner than cells, but what may be a line "
            f"is {first.line_width:.0f} pixels wide between regions of {first.cell_size:.0f} pixels. Number "
            "the cells of a binary mask, e.g. by scipy.ndimage.label; pass kind='outlines' for thick lines."
        )
    return (thin or outlined)[0]


def _between(lines: Bool[np.ndarray, "rows columns"]) -> _Outlined | int:
    """The regions that lines separate, or how many there are if they are not at least two."""
    regions = np.zeros(lines.shape, np.int64)
    label(~lines, output=regions)
    count = int(regions.max())
    sizes = np.bincount(regions.ravel(), minlength=count + 1)[1:]
    typical = float(np.median(sizes)) if count else 0.0
    # Specks between thick lines are no cells.
    cells = np.flatnonzero(sizes > _SPECK * typical) + 1
    if len(cells) < 2:
        return len(cells)
    line = ~np.isin(regions, cells)
    transform: Any = distance_transform_edt(line, return_indices=True)
    distance, nearest = transform
    regions = regions[tuple(nearest)]
    half_width = _half_width(regions, distance)
    # What is farther from all cells than any point of a line, junctions included, is no line.
    regions[distance > 2 * half_width + 1] = 0
    border = np.concatenate([regions[0], regions[-1], regions[1:-1, 0], regions[1:-1, -1]])
    met = np.bincount(border, minlength=count + 1)
    inside = np.flatnonzero((met == 0) & (np.bincount(regions.ravel(), minlength=count + 1) > 0))
    inside = inside[inside > 0]
    large = len(inside) > 2 and sizes > _OUTSIDE * np.median(sizes[inside - 1])
    outside = np.flatnonzero((met[1:] > 0) & (large | (met[1:] > 0.4 * len(border)))) + 1
    regions[np.isin(regions, outside)] = 0
    labels = np.unique(np.append(0, regions), return_inverse=True)[1][1:].reshape(lines.shape)
    return _Outlined(labels, 2 * half_width - 1, float(np.sqrt(typical)))


def _half_width(
    regions: Int[np.ndarray, "rows columns"], distance: Float[np.ndarray, "rows columns"]
) -> float:
    """Distance from both regions at which neighbours meet: lower quartile of each pair, median over all."""
    first, second, met = [], [], []
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        ((slice(1, None),), (slice(-1),)),
    ):
        differ = regions[one] != regions[other]
        first.append(np.minimum(regions[one], regions[other])[differ])
        second.append(np.maximum(regions[one], regions[other])[differ])
        met.append(np.maximum(distance[one], distance[other])[differ])
    pairs = np.stack([np.concatenate(first), np.concatenate(second)], axis=1)
    pair = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    # The lower quartile: cells on the outline of a cluster also meet far out in its surroundings.
    order = np.lexsort((np.concatenate(met), pair))
    counts = np.bincount(pair)
    quartile = order[np.cumsum(counts) - counts + (counts - 1) // 4]
    return float(np.median(np.concatenate(met)[quartile]))
