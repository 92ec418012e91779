"""Pictures of a tissue."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Real, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize

from vertax._tissue import Tissue
from vertax.plotting import _style
from vertax.plotting._polygons import box_outline, cell_polygons, cell_sides

# The light end of inferno would vanish on the pale faces under it.
_EDGE_COLOURS = ListedColormap(colormaps["inferno"](np.linspace(0, 0.82, 256)), "inferno_dark")


def plot_tissue(
    tissue: Tissue,
    cells: Real[Array | np.ndarray, " ..."] | None = None,
    edges: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    ax: Axes | None = None,
    mask: Bool[Array | np.ndarray, " ..."] | None = None,
    cmap: str | Colormap = "viridis",
    vmin: float | None = None,
    vmax: float | None = None,
    label: str | None = None,
    edge_cmap: str | Colormap = _EDGE_COLOURS,
    edge_vmin: float | None = None,
    edge_vmax: float | None = None,
    edge_label: str | None = None,
    colorbar: bool = True,
    alpha: float | None = None,
    linewidth: float | None = None,
    image: Real[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns rgb"] | None = None,
    pixel_size: float = 1.0,
) -> Axes:
    """Draw a tissue, its cells and edges coloured by values.

    Periodic cells are drawn whole, each with its centroid in the home box (a thin dashed outline),
    so edges across the boundary show twice, once at either cell.

    Over a microscopy image the y axis points down, and the membranes are drawn as lines:

    ```python
    vx.plot_tissue(tissue, image=membranes, pixel_size=0.2)
    ```

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `cells`: one value for each cell; cells whose value is not finite are grey. Left out: pale
        faces, or none over an image.
    - `edges`: one value for each edge, drawn as thick coloured lines.
    - `ax`: the axes to draw in; by default those of a new figure.
    - `mask`: which cells to draw, a boolean for each; by default all.
    - `cmap`, `edge_cmap`: colour maps, by default even steps to the eye that colour-blind readers
        see too. For values with a meaningful zero pass a diverging one (`"RdBu_r"`) and symmetric
        limits.
    - `vmin`, `vmax`, `edge_vmin`, `edge_vmax`: limits of the colours; by default those of the
        finite values drawn.
    - `label`, `edge_label`: labels of the colour bars.
    - `colorbar`: whether to draw colour bars.
    - `alpha`: opacity of the faces, from 0 to 1; by default 1, or 0.5 over an image.
    - `linewidth`: of the cell outlines, in points; by default it follows the size of a cell.
        Coloured edges are three times as wide.
    - `image`: a grey image, shown with robust contrast, or a colour image (8 bits, red green blue).
        The pixel in row r and column c covers [c, c + 1] × [r, r + 1] `pixel_size`.
    - `pixel_size`: size of a pixel, in the tissue's units of length.

    **Returns:** the axes.

    **Raises:**

    - `ValueError`, naming the argument, for values of the wrong length, an image that is not one,
        or a `pixel_size` or `alpha` out of range.
    """
    cell_values = _values("cells", cells, tissue.n_cells)
    edge_values = _values("edges", edges, tissue.n_edges)
    shown = _values("mask", mask, tissue.n_cells)
    shown = np.ones(tissue.n_cells, bool) if shown is None else shown.astype(bool)
    if not (np.isfinite(pixel_size) and pixel_size > 0):
        raise ValueError(f"Argument `pixel_size` must be positive, but is {pixel_size}.")
    if alpha is not None and not 0 <= alpha <= 1:
        raise ValueError(f"Argument `alpha` must lie in 0 … 1, but is {alpha}.")
    if image is not None and (0 in image.shape or image.ndim not in (2, 3)):
        raise ValueError(
            "Argument `image` must have shape (rows, columns) or (rows, columns, 3), but has "
            f"{image.shape}."
        )

    polygons, _ = cell_polygons(tissue)
    polygons = polygons[shown]
    segments, half_edges = cell_sides(tissue, shown)
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=3.8, height=3.2)
        if image is not None:
            _draw_image(ax, image, pixel_size)
        outline = None if image is not None else box_outline(tissue)
        _set_view(ax, polygons, outline, image is not None)
        if linewidth is None:
            linewidth = _line_width(ax, tissue)
        if outline is not None:
            ax.plot(
                *outline.T,
                color="0.45",
                lw=0.6,
                ls=(0, (5, 4)),
                zorder=3,
                scalex=False,
                scaley=False,
            )

        faces = PolyCollection(list(polygons), closed=True, linewidths=0, zorder=1)
        bars: list[tuple[ScalarMappable, np.ndarray, str | None]] = []
        if cell_values is not None:
            drawn = cell_values[shown]
            _colour(faces, drawn, cmap, vmin, vmax)
            bars.append((faces, drawn, label))
        else:
            faces.set_facecolor(_style.BLANK if image is None else "none")
        faces.set_alpha(alpha if alpha is not None else 1 if image is None else 0.5)
        ax.add_collection(faces, autolim=False)

        lines = LineCollection(list(segments), capstyle="round", zorder=2)
        if edge_values is not None:
            drawn = edge_values[np.asarray(tissue.topology.edge)[half_edges]]
            _colour(lines, drawn, edge_cmap, edge_vmin, edge_vmax)
            lines.set_linewidth(3 * linewidth)
            bars.append((lines, drawn, edge_label))
        else:
            lines.set_color(_style.INK if image is None else _style.HIGHLIGHT)
            lines.set_linewidth(linewidth)
        ax.add_collection(lines, autolim=False)
        if colorbar:
            for place, bar in enumerate(bars):
                _colour_bar(ax, *bar, place=place, places=len(bars))
    return ax


def _values(name: str, values: Any, n: int) -> np.ndarray | None:
    if values is None:
        return None
    values = np.asarray(values)
    if values.shape != (n,):
        raise ValueError(f"Argument `{name}` must have shape ({n},), but has {values.shape}.")
    return values


def _draw_image(ax: Axes, image: np.ndarray, pixel_size: float) -> None:
    rows, columns = image.shape[:2]
    grey: dict[str, Any] = {}
    if image.ndim == 2:
        # A few saturated or dead pixels must not set the contrast.
        low, high = np.nanpercentile(image, [1, 99.7])
        grey = {"cmap": "gray", "vmin": low, "vmax": max(high, np.nextafter(low, np.inf))}
    extent = (0.0, columns * pixel_size, rows * pixel_size, 0.0)
    ax.imshow(image, origin="upper", extent=extent, zorder=0, **grey)


def _set_view(
    ax: Axes,
    polygons: Float[np.ndarray, "cells sides 2"],
    outline: np.ndarray | None,
    over_image: bool,
) -> None:
    ax.set_aspect("equal")
    ax.set_axis_off()
    if over_image:
        return  # the view is the image
    points = polygons.reshape(-1, 2)
    if outline is not None:
        points = np.concatenate([points, outline])
    if len(points) == 0:
        return
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.02 * (high - low).max()
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)


def _line_width(ax: Axes, tissue: Tissue) -> float:
    """Width of outlines in points: a few per cent of a cell, within what prints well."""
    box = ax.get_window_extent()
    width, height = np.array([box.width, box.height]) * 72 / _style.figure_of(ax).dpi
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    points_per_length = min(width / abs(x1 - x0), height / abs(y1 - y0))
    cell = float(np.sqrt(np.mean(np.abs(np.asarray(tissue.areas, float)))))
    return float(np.clip(0.035 * cell * points_per_length, 0.2, 1.0))


def _colour(
    artist: PolyCollection | LineCollection,
    values: np.ndarray,
    cmap: str | Colormap,
    vmin: float | None,
    vmax: float | None,
) -> None:
    colours = (colormaps[cmap] if isinstance(cmap, str) else cmap).with_extremes(bad=_style.MISSING)
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    artist.set_cmap(colours)
    artist.set_norm(Normalize(low if vmin is None else vmin, high if vmax is None else vmax))
    artist.set_array(np.ma.masked_invalid(values))


def _colour_bar(
    ax: Axes,
    mappable: ScalarMappable,
    values: np.ndarray,
    label: str | None,
    *,
    place: int,
    places: int,
) -> None:
    """A colour bar right of the axes, as high as they are; two of them share the height."""
    # An inset of the axes themselves follows their equal aspect and takes no room from others.
    gap = 0.1
    height = (1 - gap * (places - 1)) / places
    inset = ax.inset_axes((1.02, (places - 1 - place) * (height + gap), 0.035, height))
    norm = mappable.norm
    finite = values[np.isfinite(values)]
    below = finite.size and finite.min() < norm.vmin
    above = finite.size and finite.max() > norm.vmax
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    bar = _style.figure_of(ax).colorbar(
        mappable, cax=inset, extend=extend[bool(below), bool(above)], label=label or ""
    )
    bar.outline.set_linewidth(0.4)
    bar.solids.set_alpha(1)
