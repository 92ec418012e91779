"""Replicates in one figure: bands, box plots, colours and limits."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Real
from matplotlib.axes import Axes

from vertax.plotting import INK, SERIES

Values = Real[np.ndarray, " ..."]


def series_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour of `SERIES` for each name; they repeat after seven."""
    return {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)}


def same_limits(axes: Iterable[Axes], *, x: bool = True, y: bool = True) -> None:
    """Give panels common limits of x and y that show all data; call this after drawing everything."""
    panels = list(axes)
    for wanted, limits, change in (
        (x, [ax.get_xlim() for ax in panels], Axes.set_xlim),
        (y, [ax.get_ylim() for ax in panels], Axes.set_ylim),
    ):
        if wanted:
            for ax in panels:
                change(ax, np.min(limits), np.max(limits))


def plot_band(
    curves: Values, ax: Axes, *, label: str, colour: str, log: bool = False, extremes: bool = False
) -> None:
    """Draw the mean of curves of shape `(epochs, replicates)`, and a band of one standard deviation.

    With `log` these are the mean and deviation of the logarithm, of positive values; with `extremes` the band
    extends from the smallest to the largest value. Where no value is valid, the curve has a gap.
    """
    values = np.asarray(curves, float)
    valid = np.isfinite(values) & (values > 0 if log else True)
    if log:
        values = np.log(np.where(valid, values, 1.0))
    values = np.ma.array(values, mask=~valid)
    middle, deviation = values.mean(axis=1), values.std(axis=1)
    low, high = middle - deviation, middle + deviation
    if extremes:
        low, high = values.min(axis=1), values.max(axis=1)
    lines = [np.ma.filled(np.ma.asarray(line, float), np.nan) for line in (middle, low, high)]
    middle, low, high = np.exp(lines) if log else lines
    epochs = np.arange(len(values))
    ax.plot(epochs, middle, color=colour, label=label, lw=1)
    ax.fill_between(epochs, low, high, color=colour, alpha=0.15, lw=0)
    if log:
        ax.set_yscale("log")


def plot_boxes(
    groups: Mapping[str, Values], ax: Axes, *, colours: Mapping[str, str], log: bool = False
) -> None:
    """Draw a box plot (median, quartiles) of each group of numbers, and every finite number as a point.

    On a logarithmic axis, numbers that are not positive are triangles at the lower end.
    """
    data = {name: np.ravel(np.asarray(values, float)) for name, values in groups.items()}
    data = {name: values[np.isfinite(values)] for name, values in data.items()}
    drawn = [values[values > 0] if log else values for values in data.values()]
    if log:
        ax.set_yscale("log")
    lines = {"color": "0.5", "lw": 0.8}
    style = dict.fromkeys(("boxprops", "whiskerprops", "capprops"), lines)
    ax.boxplot(drawn, widths=0.5, showfliers=False, medianprops={"color": INK}, **style)
    for k, (name, points) in enumerate(zip(data, drawn, strict=True), start=1):
        ax.plot(np.full(len(points), k), points, ".", ms=4, color=colours[name], zorder=3)
        if len(points) < len(data[name]):
            bottom = ax.get_xaxis_transform()
            ax.plot(k, 0.03, "v", ms=4, color=colours[name], transform=bottom, scaley=False)
    ax.set_xticks(range(1, len(data) + 1), list(data))
