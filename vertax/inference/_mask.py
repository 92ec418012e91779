"""Label images from whatever a segmentation was saved as."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Array, Int, Shaped
from scipy.ndimage import distance_transform_edt, label

from vertax.io import read_image

_KINDS = ("auto", "labels", "outlines")
# A region at the border of the image that is so many times as large as the median cell is none.
_OUTSIDE = 5.0
# What is smaller than this share of it is none either.
_SPECK = 0.03


def read_mask(
    image: Shaped[np.ndarray | Array, "..."] | str | os.PathLike[str],
    *,
    kind: str = "auto",
    background: int | None = None,
) -> Int[np.ndarray, "rows columns"]:
    """A label for each pixel, from a label image or an image of outlines.

    - **Labels**: integers, or a colour for each cell; also `NAME_seg.npy` of Cellpose.
    - **Outlines**: two values, of which the rarer one is the line, as of Tissue Analyzer, EPySeg and
        skeletons; grey or in colours, of any thickness, connected by sides or by corners of pixels. Each
        region within lines is a cell, and the lines go half to each of their sides. A region at the border
        of the image is a cell that the border cuts; but one that has most of the border, or is much larger
        than cells, is outside.

    **Arguments:**

    - `image`: the pixels, shape (rows, columns) or (rows, columns, colours); or a file: TIFF, PNG, NPY.
    - `kind`: `"labels"`, `"outlines"`, or `"auto"`: outlines if there are two values or colours.
    - `background`: the label of what is no cell, if it is not 0.

    **Returns:** the labels, 0 where there is no cell. See [`from_labels`][vertax.initialise.from_labels].

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` for an unknown `kind`, pixels of another shape or that are not finite, a `background`
        that no pixel has, and outlines that enclose less than two cells.
    """
    if kind not in _KINDS:
        raise ValueError(
            f"Argument `kind` must be one of {', '.join(map(repr, _KINDS))}, but is {kind!r}."
        )
    pixels = _loaded(Path(image)) if isinstance(image, str | os.PathLike) else np.asarray(image)
    values = _numbered(pixels)
    if background is not None:
        if not np.any(values == background):
            raise ValueError(
                f"Argument `background` must be a label of the mask, but no pixel has {background}."
            )
        values = np.where(values == background, 0, values)
    counts = np.unique(values, return_counts=True)
    if kind == "outlines" or (kind == "auto" and len(counts[0]) == 2):
        if len(counts[0]) < 2:
            raise ValueError("Argument `image` must show lines, but all its pixels are alike.")
        lines = values != 0
        if len(counts[0]) == 2:
            lines = values == counts[0][np.argmin(counts[1])]
        return _within(lines)
    return values


def _loaded(file: Path) -> np.ndarray:
    if file.suffix.lower() == ".npy":
        if not file.exists():
            raise FileNotFoundError(
                f"Argument `image` must name a file, but {file} does not exist."
            )
        # Cellpose saves a dictionary, which only pickles hold; masks are plain arrays.
        if file.name.endswith("_seg.npy"):
            held = np.load(file, allow_pickle=True)
            held = held.item() if held.dtype == object and held.ndim == 0 else {}
            if not isinstance(held, dict) or "masks" not in held:
                raise ValueError(f"{file} must hold `masks`, as Cellpose saves them, but does not.")
            return np.asarray(held["masks"])
        return np.load(file, allow_pickle=False)
    try:
        return read_image(file)
    except ValueError as error:
        if "`channel`" not in str(error):
            raise
    return np.stack([read_image(file, channel=k) for k in range(3)], axis=-1)


def _numbered(pixels: Shaped[np.ndarray, "..."]) -> Int[np.ndarray, "rows columns"]:
    """Integers, one for each colour; black is 0."""
    if pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        pixels = pixels[..., :3]
        flat = pixels.reshape(-1, 3)
        colours, index = np.unique(flat, axis=0, return_inverse=True)
        number = np.arange(1, len(colours) + 1)
        number[np.all(colours == 0, axis=1)] = 0
        return number[index.ravel()].reshape(pixels.shape[:2])
    if pixels.ndim != 2 or pixels.size == 0:
        raise ValueError(
            "Argument `image` must have shape (rows, columns), or a third axis of colours, but its shape is "
            f"{pixels.shape}. Pass one plane of a stack."
        )
    if pixels.dtype.kind == "b":
        return pixels.astype(np.int64)
    if pixels.dtype.kind == "f":
        if not np.isfinite(pixels).all() or np.any(pixels != np.rint(pixels)):
            raise ValueError(
                "Argument `image` must hold whole numbers, a label for each pixel, but holds "
                f"{pixels[~(pixels == np.rint(pixels))].flat[0]}. A grey image must be segmented first."
            )
        return np.rint(pixels).astype(np.int64)
    if pixels.dtype.kind not in "iu":
        raise ValueError(f"Argument `image` must hold numbers, but its dtype is {pixels.dtype}.")
    return pixels.astype(np.int64)


def _within(lines: Shaped[np.ndarray, "rows columns"]) -> Int[np.ndarray, "rows columns"]:
    """Numbers of the regions that lines enclose."""
    regions = np.zeros(lines.shape, np.int64)
    label(~lines, output=regions)
    count = int(regions.max())
    sizes = np.bincount(regions.ravel(), minlength=count + 1)[1:]
    typical = float(np.median(sizes)) if count else 0.0
    # Specks between thick lines are no cells.
    cells = np.flatnonzero(sizes > _SPECK * typical) + 1
    if len(cells) < 2:
        raise ValueError(
            "Argument `image` must show lines that enclose cells, but they enclose "
            f"{'one region' if len(cells) else 'nothing'}: are they closed?"
        )
    between = ~np.isin(regions, cells)
    nearest = distance_transform_edt(between, return_distances=False, return_indices=True)
    regions = regions[tuple(np.asarray(nearest))]
    border = np.concatenate([regions[0], regions[-1], regions[1:-1, 0], regions[1:-1, -1]])
    met = np.bincount(border, minlength=count + 1)
    inside = np.flatnonzero((met == 0) & (np.bincount(regions.ravel(), minlength=count + 1) > 0))
    large = len(inside) > 2 and sizes > _OUTSIDE * np.median(sizes[inside - 1])
    outside = np.flatnonzero((met[1:] > 0) & (large | (met[1:] > 0.4 * len(border)))) + 1
    regions[np.isin(regions, outside)] = 0
    return np.unique(np.append(0, regions), return_inverse=True)[1][1:].reshape(lines.shape)
