"""Colour scales and colour bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, SupportsFloat

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, ListedColormap, Normalize

from vertax.plotting import _style

# The light end of inferno is invisible on pale faces, the dark end on an image.
EDGES_ON_PALE = ListedColormap(colormaps["inferno"](np.linspace(0, 0.82, 256)), "inferno_dark")
EDGES_ON_DARK = ListedColormap(colormaps["inferno"](np.linspace(0.38, 1, 256)), "inferno_light")


class Colours(NamedTuple):
    """A colour map, its limits and the label of its bar."""

    cmap: str | Colormap | None = None
    low: SupportsFloat | None = None
    high: SupportsFloat | None = None
    label: str | None = None

    def limits(self, values: np.ndarray) -> tuple[float, float]:
        """The given limits, or else those of the finite values."""
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        return (
            float(low if self.low is None else self.low),
            float(high if self.high is None else self.high),
        )

    def scale(self, values: np.ndarray) -> ScalarMappable:
        """The mappable for a colour bar."""
        return ScalarMappable(Normalize(*self.limits(values)), colour_map(self.cmap))

    def apply(self, artist: PolyCollection | LineCollection, values: np.ndarray) -> None:
        """Colour the parts of an artist by their values."""
        artist.set_cmap(colour_map(self.cmap))
        artist.set_norm(Normalize(*self.limits(values)))
        artist.set_array(np.ma.masked_invalid(values))


def colour_map(cmap: str | Colormap | None) -> Colormap:
    """A colour map with the colour of missing values."""
    named = colormaps[cmap or "viridis"] if not isinstance(cmap, Colormap) else cmap
    return named.with_extremes(bad=_style.MISSING)


def add_bar(
    axes: Axes | Sequence[Axes],
    mappable: ScalarMappable,
    values: np.ndarray,
    label: str | None,
    **options: Any,
) -> Colorbar:
    """A colour bar with arrows and the extreme values where values lie beyond its ends."""
    figure = _style.figure_of(axes if isinstance(axes, Axes) else axes[0])
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (np.inf, -np.inf)
    bottom, top = mappable.get_clim()
    assert bottom is not None
    assert top is not None
    below, above = bool(low < bottom), bool(high > top)
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    bar = figure.colorbar(mappable, ax=axes, extend=extend, label=label or "", **options)
    bar.outline.set_linewidth(0.4)
    if bar.solids is not None:
        bar.solids.set_alpha(1)
    # The arrows extend 5 % of the bar beyond its ends.
    for shown, value, place, side in ((below, low, -0.06, "top"), (above, high, 1.06, "bottom")):
        if shown:
            text = f"{value:.3g}"
            bar.ax.text(0.5, place, text, transform=bar.ax.transAxes, ha="center", va=side, size=7)
    return bar


def bar_beside(
    ax: Axes, mappable: ScalarMappable, values: np.ndarray, label: str | None, *, innermost: bool
) -> None:
    """A colour bar right of the axes, about as high as the tissue."""
    figure = _style.figure_of(ax)
    # If the axes are higher than the tissue, an equal aspect leaves room above and below. The bar,
    # its ticks and its label take about 0.7 inches of the width.
    box = ax.get_position(original=True)
    width, height = np.array([box.width, box.height]) * figure.get_size_inches()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    tissue_height = max(width - 0.7, 0.3) * abs((y1 - y0) / (x1 - x0))
    # Only a layout engine computes the room for the ticks and the label of another bar.
    pad = 0.02 if innermost or figure.get_layout_engine() is not None else 0.25
    shrink = min(1.0, tissue_height / height)
    add_bar(ax, mappable, values, label, fraction=0.05, pad=pad, aspect=22, shrink=shrink)
