"""Replicates in one figure: bands and box plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vertax.plotting import _style


def plot_band(
    curves: Real[Array | np.ndarray, " ..."],
    x: Real[Array | np.ndarray, " ..."] | Sequence[float] | None = None,
    *,
    spread: str = "deviation",
    log: bool = False,
    ax: Axes | None = None,
    figure: Figure | None = None,
    label: str | None = None,
    colour: str | None = None,
) -> Axes:
    """Draw the mean of replicate curves with a band.

    The mean excludes values that are not finite, and on a logarithmic axis those that are not positive; where
    no value is left, the curve has a gap.

    **Arguments:**

    - `curves`: shape `(epochs, replicates)`, a curve in each column, such as `fit.history.cost` of a batch
        of fits.
    - `x`: the abscissa of each row, by default 0, 1, 2, …
    - `spread`: of the band: `"deviation"`, plus and minus one standard deviation, or `"range"`, from the
        smallest to the largest value.
    - `log`: take mean and deviation of the logarithm, and draw on a logarithmic axis.
    - `ax`: the axes to draw in, also for several bands to compare; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `label`: name in the legend, which the caller draws.
    - `colour`: by default the next of `SERIES`.

    **Returns:** the axes.

    **Raises:**

    - `ValueError`, naming the argument, for shapes that do not match or an unknown `spread`.
    """
    values = np.asarray(curves, float)
    places = np.arange(len(values)) if x is None and values.ndim else np.asarray(x, float)
    _style.one_of(ax, figure)
    if values.ndim != 2:
        raise ValueError(
            f"Argument `curves` must have shape (epochs, replicates), but has {values.shape}."
        )
    if places.shape != values.shape[:1]:
        raise ValueError(
            f"Argument `x` must have one entry for each of {len(values)} rows, but has shape "
            f"{places.shape}."
        )
    if spread not in ("deviation", "range"):
        raise ValueError(f'Argument `spread` must be "deviation" or "range", but is {spread!r}.')
    valid = np.isfinite(values) & (values > 0 if log else True)
    if log:
        values = np.log(np.where(valid, values, 1.0))
    values = np.ma.array(values, mask=~valid)
    middle = values.mean(axis=1)
    if spread == "range":
        low, high = values.min(axis=1), values.max(axis=1)
    else:
        deviation = values.std(axis=1)
        low, high = middle - deviation, middle + deviation
    middle, low, high = (np.ma.filled(np.ma.asarray(v, float), np.nan) for v in (middle, low, high))
    if log:
        middle, low, high = np.exp(middle), np.exp(low), np.exp(high)
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=3.0, height=2.3, figure=figure)
        if colour is None:
            colour = _style.SERIES[len(ax.lines) % len(_style.SERIES)]
        ax.plot(places, middle, color=colour, label=label, lw=1)
        ax.fill_between(places, low, high, color=colour, alpha=0.15, lw=0)
        if log:
            ax.set_yscale("log")
    return ax


def plot_boxes(
    groups: Mapping[str, Real[Array | np.ndarray, " ..."] | Sequence[float]],
    *,
    log: bool = False,
    ax: Axes | None = None,
    figure: Figure | None = None,
    colours: Mapping[str, str] | None = None,
) -> Axes:
    """Draw a box plot (median, quartiles) of each group of numbers, and every number as a point.

    On a logarithmic axis, numbers that are not positive are triangles at the lower end.

    **Arguments:**

    - `groups`: the numbers of each group by its name; those that are not finite are left out.
    - `log`: on a logarithmic axis.
    - `ax`: the axes to draw in; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `colours`: of the points by the name of the group; by default those of `series_colours`.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if there is no group, or a group without a colour.
    """
    _style.one_of(ax, figure)
    if not groups:
        raise ValueError("Argument `groups` must have at least one group, but is empty.")
    colours = _style.series_colours(groups) if colours is None else colours
    if missing := [name for name in groups if name not in colours]:
        raise ValueError(
            f"Argument `colours` must have a colour for each group, but has none for {missing}."
        )
    data = {name: np.ravel(np.asarray(values, float)) for name, values in groups.items()}
    data = {name: values[np.isfinite(values)] for name, values in data.items()}
    drawn = [values[values > 0] if log else values for values in data.values()]
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=0.8 + 0.6 * len(data), height=2.3, figure=figure)
        if log:
            ax.set_yscale("log")
        lines: Any = {"color": "0.5", "lw": 0.8}
        ax.boxplot(
            drawn,
            widths=0.5,
            showfliers=False,
            medianprops={"color": _style.INK},
            boxprops=lines,
            whiskerprops=lines,
            capprops=lines,
        )
        for k, (name, points) in enumerate(zip(data, drawn, strict=True), start=1):
            ax.plot(np.full(len(points), k), points, ".", ms=4, color=colours[name], zorder=3)
            if len(points) < len(data[name]):
                bottom = ax.get_xaxis_transform()
                ax.plot(k, 0.03, "v", ms=4, color=colours[name], transform=bottom, scaley=False)
        ax.set_xticks(range(1, len(data) + 1), list(data))
    return ax
