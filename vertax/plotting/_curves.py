"""Convergence curves of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vertax.fitting import History
from vertax.plotting import _style

# Columns of a history in the order of the panels, with title and scale of the axis.
_CURVES = {
    "cost": ("cost", "log"),
    "relative_error": ("relative error of parameters", "log"),
    "max_force": ("largest force", "log"),
    "num_t1": ("T1 transitions", "linear"),
}


def plot_history(
    history: History | Mapping[str, Real[Array | np.ndarray, " ..."]],
    *,
    axes: Sequence[Axes] | np.ndarray | None = None,
    figure: Figure | None = None,
    label: str | None = None,
) -> list[Axes]:
    """Draw the convergence of a fit: one panel for each curve of the history.

    Curves are drawn on a logarithmic axis; curves with negative values or only zeros (a number of
    transitions, for example) on a linear one. Epochs without a finite value leave a gap.

    **Arguments:**

    - `history`: of a [`Fit`][vertax.Fit], or values per epoch by name: `cost`, and optionally
        `relative_error`, `max_force` and `num_t1`; other entries are ignored.
    - `axes`: where to draw, one for each panel, to compare several fits; by default a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `label`: name of this fit in the legend.

    **Returns:** the axes of the panels.

    **Raises:**

    - `ValueError` if the history has no `cost`, if its curves differ in length, or if the number of
        `axes` is not that of the panels.
    """
    _style.one_of(axes, figure, "axes")
    if isinstance(history, History):
        history = history.columns()
    if "cost" not in history:
        raise ValueError(
            "Argument `history` must hold `cost`, but holds "
            f"{', '.join(map(str, history)) or 'nothing'}."
        )
    curves = {name: np.asarray(history[name], float) for name in _CURVES if name in history}
    shapes = {name: curve.shape for name, curve in curves.items()}
    if len(set(shapes.values())) > 1 or len(shapes["cost"]) != 1:
        raise ValueError(
            f"Argument `history` must hold one value for each epoch, but has the shapes {shapes}."
        )
    if axes is not None and len(axes) != len(curves):
        raise ValueError(
            f"Argument `axes` must have one entry for each of {', '.join(curves)}, but has "
            f"{len(axes)}."
        )
    with _style.house_style():
        if axes is None:
            axes = _style.new_axes(len(curves), width=2.3, height=2.0, figure=figure)
        panels = list(axes)
        for panel, (name, curve) in zip(panels, curves.items(), strict=True):
            colour = _style.SERIES[len(panel.lines) % len(_style.SERIES)]
            epochs = np.arange(len(curve))
            title, scale = _CURVES[name]
            logarithmic = scale == "log" and not np.any(curve < 0) and np.any(curve > 0)
            # On a logarithmic axis zeros are gaps, like missing values.
            values = np.where(curve > 0, curve, np.nan) if logarithmic else curve
            # A curve of one epoch, or between two gaps, is visible only as a point.
            few = {"marker": "o", "markersize": 2.5} if len(curve) < 15 else {}
            panel.plot(epochs, values, color=colour, label=label, **few)
            panel.set_yscale("log" if logarithmic else "linear")
            if np.issubdtype(np.asarray(history[name]).dtype, np.integer):
                panel.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
                top = max(1.0, panel.dataLim.y1)  # with only zeros the ticks would be fractions
                panel.set_ylim(-0.03 * top, 1.05 * top)
            panel.set_xlabel("epoch")
            panel.set_ylabel(title)
        if label is not None:
            panels[0].legend()
    return panels
