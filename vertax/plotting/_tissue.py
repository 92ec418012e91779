"""Pictures of a tissue."""

from __future__ import annotations

from typing import Any, NamedTuple, SupportsFloat

import numpy as np
from jaxtyping import Array, Bool, Real
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.lines import Line2D

from vertax.mesh import Tissue
from vertax.mesh._outlines import Drawing
from vertax.plotting import _style

# Of inferno, the light end would vanish on pale faces, and the dark end on an image.
_EDGES_ON_PALE = ListedColormap(colormaps["inferno"](np.linspace(0, 0.82, 256)), "inferno_dark")
_EDGES_ON_DARK = ListedColormap(colormaps["inferno"](np.linspace(0.38, 1, 256)), "inferno_light")


def plot_tissue(
    tissue: Tissue,
    cells: Real[Array | np.ndarray, " ..."] | None = None,
    edges: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    ax: Axes | None = None,
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
    pixel_size: SupportsFloat = 1.0,
) -> Axes:
    """Draw a tissue, its cells and edges coloured by values.

    Periodic cells are drawn whole, each with its centroid in the home box (a thin dashed outline),
    so edges across the boundary show twice, once at either cell.

    Over a microscopy image the y axis points down, the membranes are drawn as lines, and a periodic tissue
    is repeated as far as the image goes:

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
    - `highlight`: edges to mark, a boolean for each, such as those of
        [`flipped_edges`][vertax.plotting.flipped_edges].
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
    - `image`: a grey image, shown with robust contrast, or a colour image (red, green, blue; 8
        bits, or floats in 0 … 1). The pixel in row r and column c covers [c, c + 1] × [r, r + 1],
        in units of `pixel_size`.
    - `pixel_size`: size of a pixel, in the tissue's units of length.

    **Returns:** the axes.

    **Raises:**

    - `ValueError`, naming the argument, for a batch of tissues, values of the wrong length, an
        image that is not one, or a `pixel_size` or `alpha` out of range.
    """
    if tissue.vertices.ndim != 2:
        raise ValueError(
            "Argument `tissue` must be a single tissue, but its vertices have shape "
            f"{tissue.vertices.shape}."
        )
    return draw(
        Drawing(tissue),
        cells,
        edges,
        ax=ax,
        mask=mask,
        highlight=highlight,
        cell_colours=Colours(cmap, vmin, vmax, label),
        edge_colours=Colours(edge_cmap, edge_vmin, edge_vmax, edge_label),
        colorbar=colorbar,
        alpha=alpha,
        linewidth=linewidth,
        image=image,
        pixel_size=float(pixel_size),
    )


class Colours(NamedTuple):
    """How values become colours."""

    cmap: str | Colormap | None = None
    low: SupportsFloat | None = None
    high: SupportsFloat | None = None
    label: str | None = None


_DEFAULT = Colours()


def draw(
    drawing: Drawing,
    cells: Any = None,
    edges: Any = None,
    *,
    ax: Axes | None = None,
    mask: Any = None,
    highlight: Any = None,
    cell_colours: Colours = _DEFAULT,
    edge_colours: Colours = _DEFAULT,
    colorbar: bool = True,
    alpha: SupportsFloat | None = None,
    linewidth: SupportsFloat | None = None,
    image: np.ndarray | None = None,
    pixel_size: float = 1.0,
) -> Axes:
    """Draw what `plot_tissue` draws, with cells placed as in `drawing`."""
    cell_values = _values("cells", cells, drawing.n_cells)
    edge_values = _values("edges", edges, drawing.n_edges)
    shown = _values("mask", mask, drawing.n_cells)
    shown = np.ones(drawing.n_cells, bool) if shown is None else shown.astype(bool)
    marked = _values("highlight", highlight, drawing.n_edges)
    opacity = float(alpha if alpha is not None else 1 if image is None else 0.5)
    if not 0 <= opacity <= 1:
        raise ValueError(f"Argument `alpha` must lie in 0 … 1, but is {opacity}.")
    if not (np.isfinite(pixel_size) and pixel_size > 0):
        raise ValueError(f"Argument `pixel_size` must be positive, but is {pixel_size}.")

    polygons, polygon_cells = drawing.polygons()[0][shown], np.flatnonzero(shown)
    segments, segment_edges = drawing.sides(shown)
    n_bars = colorbar * ((cells is not None) + (edges is not None))
    if image is None:
        outline = drawing.box
        low, high = view_of(polygons, outline)
    else:
        outline = None
        low, high = np.zeros(2), _extent(image, pixel_size)
        polygons, polygon_cells = _repeated(polygons, polygon_cells, drawing.lattice, low, high)
        segments, segment_edges = _repeated(segments, segment_edges, drawing.lattice, low, high)
    with _style.house_style():
        if ax is None:
            width, height = size_of(high - low)
            # The room for bars is ample: their height is then that of the tissue.
            (ax,) = _style.new_axes(width=width + 0.1 + 0.8 * n_bars, height=height + 0.1)
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
            _colour(faces, drawn, cell_colours)
            bars.append((faces, drawn, cell_colours.label))
        else:
            faces.set_facecolor(_style.BLANK if image is None else "none")
        faces.set_alpha(opacity)
        ax.add_collection(faces, autolim=False)

        lines = LineCollection(list(segments), capstyle="round", zorder=2)
        if edge_values is not None:
            drawn = edge_values[segment_edges]
            if edge_colours.cmap is None:
                own = _EDGES_ON_PALE if image is None else _EDGES_ON_DARK
                edge_colours = edge_colours._replace(cmap=own)
            _colour(lines, drawn, edge_colours)
            if cell_values is not None:  # a casing sets coloured lines off from coloured faces
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
            # A later bar goes between the axes and an earlier one.
            for place, bar in enumerate(reversed(bars)):
                _colour_bar(ax, *bar, innermost=place == len(bars) - 1)
            ax.set_anchor("E")  # next to its bars
    return ax


def _values(name: str, values: Any, n: int) -> np.ndarray | None:
    if values is None:
        return None
    values = np.asarray(values)
    if values.shape != (n,):
        raise ValueError(f"Argument `{name}` must have shape ({n},), but has {values.shape}.")
    return values


def draw_image(ax: Axes, image: np.ndarray, pixel_size: float) -> None:
    """An image, its first row at the top, the y axis pointing down."""
    size = _extent(image, pixel_size)
    grey: dict[str, Any] = {}
    if image.ndim == 2:
        # A few saturated or dead pixels must not set the contrast.
        dark, bright = np.nanpercentile(image, [1, 99.7])
        grey = {"cmap": "gray", "vmin": dark, "vmax": max(bright, np.nextafter(dark, np.inf))}
    extent = (0.0, float(size[0]), float(size[1]), 0.0)
    ax.imshow(image, origin="upper", extent=extent, zorder=0, **grey)


def line_width(drawing: Drawing, ax: Axes) -> float:
    """Width of the outlines of cells in points: a few per cent of a cell, within what prints well."""
    return float(np.clip(0.035 * drawing.cell_size * _scale(ax), 0.2, 1.0))


def _mark(ax: Axes, segments: np.ndarray, linewidth: float) -> None:
    """Marked edges: thick, in a colour that no colour map of cells or edges has, on a white casing."""
    width = max(4.5 * linewidth, 2.5)  # an edge that has just flipped is short, and must be seen
    for extra, colour in ((1.6, "w"), (0.0, _style.MARK)):
        lines = LineCollection(list(segments), colors=colour, linewidths=width + extra)
        lines.set(capstyle="round", zorder=2.5)
        ax.add_collection(lines, autolim=False)


def _extent(image: np.ndarray, pixel_size: float) -> np.ndarray:
    """Width and height of an image."""
    if image.size == 0 or image.ndim < 2 or image.shape[2:] not in ((), (3,)):
        raise ValueError(
            "Argument `image` must have shape (rows, columns) or (rows, columns, 3), but has "
            f"{image.shape}."
        )
    return pixel_size * np.array(image.shape[1::-1])


def _repeated(
    shapes: np.ndarray,
    numbers: np.ndarray,
    lattice: np.ndarray | None,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """All periodic images of some shapes that can be seen between two corners, and their numbers."""
    if lattice is None or len(shapes) == 0:
        return shapes, numbers
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    fractions = corners @ np.linalg.inv(lattice)
    # Each shape begins less than a box away from the home box.
    first, last = np.floor(fractions.min(axis=0)) - 1, np.ceil(fractions.max(axis=0)) + 1
    steps = np.stack(np.meshgrid(*map(np.arange, first, last)), axis=-1).reshape(-1, 2) @ lattice
    shifted = shapes[None] + steps[:, None, None]
    seen = np.all((shifted.max(axis=2) >= low) & (shifted.min(axis=2) <= high), axis=-1)
    return shifted[seen], np.broadcast_to(numbers, seen.shape)[seen]


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


def size_of(extent: np.ndarray) -> tuple[float, float]:
    """Width and height of a new picture in inches: of one area, whatever its shape."""
    ratio = float(np.clip(extent[1] / extent[0], 0.25, 4))
    return 3.0 / np.sqrt(ratio), 3.0 * np.sqrt(ratio)


def _scale(ax: Axes) -> float:
    """Points on paper for each unit of length."""
    figure = _style.figure_of(ax)
    box = ax.get_position(original=True)
    inches = np.array([box.width, box.height]) * figure.get_size_inches()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    return float(72 * np.min(inches / np.abs([x1 - x0, y1 - y0])))


def _colour(artist: PolyCollection | LineCollection, values: np.ndarray, colours: Colours) -> None:
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    low = low if colours.low is None else float(colours.low)
    high = high if colours.high is None else float(colours.high)
    artist.set_cmap(colour_map(colours.cmap))
    artist.set_norm(Normalize(low, high))
    artist.set_array(np.ma.masked_invalid(values))


def colour_map(cmap: str | Colormap | None) -> Colormap:
    """A colour map with the colour of what has no value."""
    named = colormaps[cmap or "viridis"] if not isinstance(cmap, Colormap) else cmap
    return named.with_extremes(bad=_style.MISSING)


def _colour_bar(
    ax: Axes, mappable: ScalarMappable, values: np.ndarray, label: str | None, *, innermost: bool
) -> None:
    """A colour bar right of the axes, about as high as the tissue."""
    figure = _style.figure_of(ax)
    finite = values[np.isfinite(values)]
    below = bool(finite.size and finite.min() < mappable.norm.vmin)
    above = bool(finite.size and finite.max() > mappable.norm.vmax)
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    # In a place that is higher than the tissue is, an equal aspect leaves room above and below. The
    # bar, its ticks and label take about 0.7 inches off the width.
    box = ax.get_position(original=True)
    width, height = np.array([box.width, box.height]) * figure.get_size_inches()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    tissue_height = max(width - 0.7, 0.3) * abs((y1 - y0) / (x1 - x0))
    # Only a layout engine knows how much room the ticks and the label of another bar will take.
    pad = 0.02 if innermost or figure.get_layout_engine() is not None else 0.25
    bar = figure.colorbar(
        mappable,
        ax=ax,
        extend=extend,
        fraction=0.05,
        pad=pad,
        aspect=22,
        shrink=min(1.0, tissue_height / height),
        label=label or "",
    )
    bar.outline.set_linewidth(0.4)
    if bar.solids is not None:
        bar.solids.set_alpha(1)
