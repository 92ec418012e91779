"""Drawing of a tissue."""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Array, Bool, Real
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vertax._base.checks import check_shape
from vertax._base.model_checks import check_single
from vertax._base.pixels import PixelSizeLike
from vertax.mesh import Drawing, Tissue
from vertax.plotting import _style
from vertax.plotting._colours import EDGES_ON_DARK, EDGES_ON_PALE, Colours, bar_beside
from vertax.plotting._image import draw_image, extent_of

# Over an image coloured cells are opaque, so that their colours are those of the bar, and shrunk to this
# fraction of their size, so that the membranes are visible between them.
_INSET = 0.8


def plot_tissue(
    tissue: Tissue,
    cells: Real[Array | np.ndarray, " ..."] | None = None,
    edges: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    ax: Axes | None = None,
    figure: Figure | None = None,
    mask: Bool[Array | np.ndarray, " ..."] | None = None,
    highlight: Bool[Array | np.ndarray, " ..."] | None = None,
    cmap: str | Colormap = "viridis",
    vmin: SupportsFloat | None = None,
    vmax: SupportsFloat | None = None,
    label: str | None = None,
    edge_cmap: str | Colormap | None = None,
    edge_vmin: SupportsFloat | None = None,
    edge_vmax: SupportsFloat | None = None,
    edge_label: str | None = None,
    colorbar: bool = True,
    alpha: SupportsFloat | None = None,
    linewidth: SupportsFloat | None = None,
    image: Real[np.ndarray, " ..."] | None = None,
    pixel_size: PixelSizeLike = 1.0,
) -> Axes:
    """Draw a tissue, its cells and edges coloured by values.

    Periodic cells are drawn in one piece, with the centroid in the box (a thin dashed outline), so edges
    across the boundary are drawn twice, once at each cell.

    A tissue on a surface is drawn in the chart; [`plot_surface`][vertax.plotting.plot_surface] draws it in
    space.

    Over a microscopy image the y axis points down, the membranes are drawn as lines, and a periodic tissue
    is repeated over the whole image:

    ```python
    vx.plot_tissue(tissue, image=membranes, pixel_size=0.2)
    ```

    **Arguments:**

    - `tissue`: the [`Tissue`][vertax.Tissue].
    - `cells`: one value for each cell; cells with a value that is not finite are grey. By default the
        cells are pale, and transparent over an image.
    - `edges`: one value for each edge, drawn as thick coloured lines.
    - `ax`: the axes to draw in; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `mask`: which cells to draw, a boolean for each; by default all.
    - `highlight`: edges to mark, a boolean for each, such as those of
        [`flipped_edges`][vertax.plotting.flipped_edges].
    - `cmap`, `edge_cmap`: colour maps, by default perceptually uniform ones that suit colour-blind
        readers. For values with a meaningful zero pass a diverging one (`"RdBu_r"`) and symmetric limits.
    - `vmin`, `vmax`, `edge_vmin`, `edge_vmax`: limits of the colours; by default those of the
        finite values drawn. Where values lie beyond, the bar has an arrow with the extreme value.
    - `label`, `edge_label`: labels of the colour bars.
    - `colorbar`: whether to draw colour bars.
    - `alpha`: opacity of the faces, from 0 to 1. By default they are opaque, and over an image drawn
        smaller, so that the membranes are visible between them. With a number cells have their full size,
        and mix with the image: their colours are not those of the bar.
    - `linewidth`: of the cell outlines, in points; by default 3.5 % of the size of a cell.
        Coloured edges are three times as wide.
    - `image`: a grey image, shown with robust contrast, or a colour image (red, green, blue; 8
        bits, or floats in 0 … 1). The pixel in row r and column c covers [c, c + 1] × [r, r + 1],
        in units of `pixel_size`.
    - `pixel_size`: side of a pixel, in the tissue's units of length, or (height, width).

    **Returns:** the axes.

    **Raises:**

    - `ValueError`, naming the argument, for a batch of tissues, values of the wrong length, an
        image of the wrong shape, or a `pixel_size` or `alpha` out of range.
    """
    return draw(
        Drawing(single(tissue)),
        cells,
        edges,
        ax=ax,
        figure=figure,
        mask=mask,
        highlight=highlight,
        cell_colours=Colours(cmap, vmin, vmax, label),
        edge_colours=Colours(edge_cmap, edge_vmin, edge_vmax, edge_label),
        colorbar=colorbar,
        alpha=alpha,
        linewidth=linewidth,
        image=image,
        pixel_size=pixel_size,
    )


def single(tissue: Tissue) -> Tissue:
    """The tissue; raise an error if it is a batch."""
    check_single(tissue)
    return tissue


_DEFAULT = Colours()


def draw(
    drawing: Drawing,
    cells: Any = None,
    edges: Any = None,
    *,
    ax: Axes | None = None,
    figure: Figure | None = None,
    view: tuple[np.ndarray, np.ndarray] | None = None,
    mask: Any = None,
    highlight: Any = None,
    cell_colours: Colours = _DEFAULT,
    edge_colours: Colours = _DEFAULT,
    colorbar: bool = True,
    alpha: SupportsFloat | None = None,
    linewidth: SupportsFloat | None = None,
    image: np.ndarray | None = None,
    pixel_size: PixelSizeLike = 1.0,
) -> Axes:
    """Like `plot_tissue`, with cells placed as in `drawing`; `view` is the part of the plane to show."""
    _style.one_of(ax, figure)
    cell_values = checked("cells", cells, drawing.n_cells)
    edge_values = checked("edges", edges, drawing.n_edges)
    shown = checked("mask", mask, drawing.n_cells)
    shown = drawing.alive if shown is None else shown.astype(bool) & drawing.alive
    marked = checked("highlight", highlight, drawing.n_edges)
    opacity = 1.0 if alpha is None else float(alpha)
    if not 0 <= opacity <= 1:
        raise ValueError(f"Argument `alpha` must lie in 0 … 1, but is {opacity}.")

    polygons, polygon_cells = drawing.polygons()[0][shown], np.flatnonzero(shown)
    if image is not None and cells is not None and alpha is None:
        centres = drawing.centroids[shown][:, None]
        polygons = centres + _INSET * (polygons - centres)
    segments, segment_edges = drawing.sides(shown)
    n_bars = colorbar * ((cells is not None) + (edges is not None))
    if image is None:
        outline = drawing.box
        low, high = view_of(polygons, outline) if view is None else view
    else:
        outline = None
        low, high = np.zeros(2), extent_of(image, pixel_size)
        polygons, polygon_cells = _repeated(polygons, polygon_cells, drawing.lattice, low, high)
        segments, segment_edges = _repeated(segments, segment_edges, drawing.lattice, low, high)
    with _style.house_style():
        if ax is None:
            width, height = _style.size_of(high - low)
            # With enough room for the bars their height is that of the tissue.
            (ax,) = _style.new_axes(
                width=width + 0.1 + 0.8 * n_bars, height=height + 0.1, figure=figure
            )
        ax.set_aspect("equal")
        ax.set_axis_off()
        if image is not None:
            draw_image(ax, image, pixel_size)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(*((low[1], high[1]) if image is None else (high[1], low[1])))
        linewidth = line_width(drawing, ax) if linewidth is None else float(linewidth)
        if outline is not None:
            dashes = (0, (5, 4))
            ax.add_line(Line2D(*outline.T, color="0.45", lw=0.6, ls=dashes, zorder=3))

        faces = PolyCollection(list(polygons), closed=True, linewidths=0, zorder=1)
        bars: list[tuple[ScalarMappable, np.ndarray, str | None]] = []
        if cell_values is not None:
            drawn = cell_values[polygon_cells]
            cell_colours.apply(faces, drawn)
            bars.append((faces, drawn, cell_colours.label))
        else:
            faces.set_facecolor(_style.BLANK if image is None else "none")
        faces.set_alpha(opacity)
        ax.add_collection(faces, autolim=False)

        lines = LineCollection(list(segments), capstyle="round", zorder=2)
        if edge_values is not None:
            drawn = edge_values[segment_edges]
            if edge_colours.cmap is None:
                edge_map = EDGES_ON_PALE if image is None else EDGES_ON_DARK
                edge_colours = edge_colours._replace(cmap=edge_map)
            edge_colours.apply(lines, drawn)
            if (
                cell_values is not None
            ):  # a white casing separates coloured lines from coloured faces
                casing = LineCollection(list(segments), colors="w", linewidths=4.5 * linewidth)
                casing.set(capstyle="round", zorder=1.5)
                ax.add_collection(casing, autolim=False)
            lines.set_linewidth(3 * linewidth)
            bars.append((lines, drawn, edge_colours.label))
        else:
            lines.set_color(_style.INK if image is None else _style.HIGHLIGHT)
            lines.set_linewidth(linewidth)
        ax.add_collection(lines, autolim=False)
        if marked is not None:
            _mark(ax, segments[marked[segment_edges].astype(bool)], linewidth)
        if n_bars:
            # Matplotlib puts each new bar between the axes and the previous bar.
            for place, bar in enumerate(reversed(bars)):
                bar_beside(ax, *bar, innermost=place == len(bars) - 1)
            ax.set_anchor("E")  # next to its bars
    return ax


def checked(name: str, values: Any, n: int) -> np.ndarray | None:
    if values is None:
        return None
    values = np.asarray(values)
    check_shape(name, values, (n,))
    return values


def line_width(drawing: Drawing, ax: Axes) -> float:
    """Width of the outlines of cells in points: 3.5 % of the cell size, between 0.2 and 1."""
    return float(np.clip(0.035 * drawing.cell_size * _scale(ax), 0.2, 1.0))


def _mark(ax: Axes, segments: np.ndarray, linewidth: float) -> None:
    """Draw marked edges: thick lines on a white casing, in a colour outside the default colour maps."""
    width = max(4.5 * linewidth, 2.5)  # an edge that has just flipped is short
    for extra, colour in ((1.6, "w"), (0.0, _style.MARK)):
        lines = LineCollection(list(segments), colors=colour, linewidths=width + extra)
        lines.set(capstyle="round", zorder=2.5)
        ax.add_collection(lines, autolim=False)


def _repeated(
    shapes: np.ndarray,
    numbers: np.ndarray,
    lattice: np.ndarray | None,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """All periodic images of some shapes that intersect the rectangle from `low` to `high`; their numbers."""
    if lattice is None or len(shapes) == 0:
        return shapes, numbers
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    fractions = corners @ np.linalg.inv(lattice)
    # Each shape begins less than a box away from the home box.
    first, last = np.floor(fractions.min(axis=0)) - 1, np.ceil(fractions.max(axis=0)) + 1
    steps = np.stack(np.meshgrid(*map(np.arange, first, last)), axis=-1).reshape(-1, 2) @ lattice
    shifted = shapes[None] + steps[:, None, None]
    visible = np.all((shifted.max(axis=2) >= low) & (shifted.min(axis=2) <= high), axis=-1)
    return shifted[visible], np.broadcast_to(numbers, visible.shape)[visible]


def view_of(polygons: np.ndarray, outline: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the part of the plane to show."""
    points = polygons.reshape(-1, 2)
    points = points if outline is None else np.concatenate([points, outline])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.zeros(2), np.ones(2)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.02 * (high - low).max()
    return low - margin, high + margin


def _scale(ax: Axes) -> float:
    """Points on paper for each unit of length."""
    figure = _style.figure_of(ax)
    box = ax.get_position(original=True)
    inches = np.array([box.width, box.height]) * figure.get_size_inches()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    return float(72 * np.min(inches / np.abs([x1 - x0, y1 - y0])))
