"""Images under tissues, label images and scale bars."""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Array, Float, Real, Shaped
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patheffects import withStroke
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

from vertax._base.checks import check_number
from vertax._base.pixels import PixelSizeLike, check_pixel_size, pixel_sides
from vertax.plotting import _style


def plot_image(
    image: Real[np.ndarray, " ..."],
    *,
    pixel_size: PixelSizeLike = 1.0,
    ax: Axes | None = None,
    figure: Figure | None = None,
) -> Axes:
    """Draw an image as [`plot_tissue`][vertax.plot_tissue] draws it under a tissue.

    **Arguments:**

    - `image`: a grey image, shown with robust contrast, or a colour image (red, green, blue; 8 bits, or
        floats in 0 … 1); labels are made one by [`label_colours`][vertax.plotting.label_colours]. The y
        axis points down.
    - `pixel_size`: side of a pixel, in units of length, or (height, width).
    - `ax`: the axes to draw in; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.

    **Returns:** the axes.

    **Raises:**

    - `ValueError`, naming the argument, for an image of the wrong shape, or a `pixel_size` that is not
        positive.
    """
    image = np.asarray(image)
    _style.one_of(ax, figure)
    width, height = extent_of(image, pixel_size)
    with _style.house_style():
        if ax is None:
            wide, high = _style.size_of(np.array([width, height]))
            (ax,) = _style.new_axes(width=wide + 0.1, height=high + 0.1, figure=figure)
        draw_image(ax, image, pixel_size)
        ax.set_aspect("equal")
        ax.set_axis_off()
        ax.set(xlim=(0, width), ylim=(height, 0))
    return ax


def draw_image(ax: Axes, image: np.ndarray, pixel_size: PixelSizeLike) -> None:
    """An image, its first row at the top, the y axis pointing down."""
    size = extent_of(image, pixel_size)
    grey: dict[str, Any] = {}
    if image.ndim == 2:
        # Percentiles, because a few saturated or dead pixels must not set the contrast.
        dark, bright = np.nanpercentile(image, [1, 99.7])
        grey = {"cmap": "gray", "vmin": dark, "vmax": max(bright, np.nextafter(dark, np.inf))}
    extent = (0.0, float(size[0]), float(size[1]), 0.0)
    ax.imshow(image, origin="upper", extent=extent, zorder=0, **grey)


def extent_of(image: np.ndarray, pixel_size: PixelSizeLike) -> np.ndarray:
    """Width and height of an image."""
    if image.size == 0 or image.ndim < 2 or image.shape[2:] not in ((), (3,)):
        raise ValueError(
            "Argument `image` must have shape (rows, columns) or (rows, columns, 3), but has "
            f"{image.shape}."
        )
    check_pixel_size("pixel_size", pixel_size)
    return pixel_sides(pixel_size) * image.shape[1::-1]


def label_colours(
    labels: Shaped[np.ndarray | Array, " ..."],
) -> Float[np.ndarray, "rows columns 3"]:
    """A colour image of a label image: a dark colour for each label, so that a mesh is visible on top.

    ```python
    vx.plot_tissue(found.tissue, image=vx.plotting.label_colours(labels), pixel_size=found.pixel_size)
    ```

    **Arguments:**

    - `labels`: a number in each pixel of a cell, 0 or less in the background.

    **Returns:** red, green and blue of each pixel, from 0 to 1; the background is black.

    **Raises:**

    - `ValueError` unless `labels` is a two-dimensional array of integers.
    """
    labels = np.asarray(labels)
    if labels.ndim != 2 or labels.dtype.kind not in "iub":
        raise ValueError(
            "Argument `labels` must hold whole numbers in rows and columns, but has shape "
            f"{labels.shape} and type {labels.dtype}."
        )
    values, place = np.unique(labels, return_inverse=True)
    # Multiples of the golden ratio: the colours of consecutive labels, often neighbours, differ most.
    number = np.arange(len(values))
    hue, value = np.modf(number * 0.618034)[0], 0.34 + 0.14 * np.modf(number * 0.381966)[0]
    colours = hsv_to_rgb(np.stack([hue, np.full(len(values), 0.45), value], axis=-1))
    colours[values <= 0] = 0
    return colours[place.reshape(labels.shape)]


def scale_bar(
    ax: Axes,
    unit: str = "",
    *,
    unit_length: SupportsFloat = 1.0,
    length: SupportsFloat | None = None,
) -> None:
    """Draw a bar of known length: in the lower right of an image, or below a tissue.

    ```python
    ax = vx.plot_tissue(tissue, image=membranes, pixel_size=0.2)
    vx.plotting.scale_bar(ax, "µm")                      # lengths of the tissue are micrometres
    vx.plotting.scale_bar(ax, "pixels", unit_length=0.2)
    ```

    **Arguments:**

    - `ax`: the axes, after all is drawn.
    - `unit`: name of the unit of length.
    - `unit_length`: length of the unit, in the tissue's units of length.
    - `length`: of the bar, in `unit`s; by default 1, 2 or 5 times a power of ten, and at most a quarter
        of the width.

    **Raises:**

    - `ValueError` if a length is not positive.
    """
    check_number("unit_length", unit_length, above=0)
    if length is not None:
        check_number("length", length, above=0)
    unit_length = float(unit_length)
    left, right = sorted(ax.get_xlim())
    length = float(_round_length((right - left) / unit_length / 4) if length is None else length)
    over_image = bool(ax.images)
    colour = "w" if over_image else _style.INK
    place: dict[str, Any] = {"loc": "lower right", "label_top": True, "borderpad": 1.2}
    if not over_image:
        place = {"loc": "upper right", "bbox_to_anchor": (1, 0), "bbox_transform": ax.transAxes}
    label, size = f"{length:g} {unit}".strip(), length * unit_length
    font = FontProperties(size=7)
    bar = AnchoredSizeBar(
        ax.transData, size, label, color=colour, sep=3, prop=font, frameon=False, **place
    )
    (line,), (text,) = bar.size_bar.get_children(), bar.txt_label.get_children()
    line.set(linewidth=2)
    if over_image:  # white with a black border is readable on any image
        line.set_path_effects([withStroke(linewidth=3.6, foreground="k")])
        text.set_path_effects([withStroke(linewidth=1.8, foreground="k")])
    ax.add_artist(bar)


def _round_length(most: float) -> float:
    """The largest number 1, 2 or 5 times a power of ten that is at most `most`."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * max(step for step in (1, 2, 5) if step * power <= most * (1 + 1e-9)))
