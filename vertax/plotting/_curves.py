"""Convergence curves of a fit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vertax.fitting import History
from vertax.plotting import _style
from vertax.plotting._tissue import checked

# Columns of a history in the order of the panels, with title and scale of the axis.
_CURVES = {
    "cost": ("cost", "log"),
    "relative_error": ("relative error of parameters", "log"),
    "max_force": ("largest force", "log"),
    "num_t1": ("T1 transitions", "linear"),
}


def plot_history(history: History, *, figure: Figure | None = None) -> list[Axes]:
    """Draw the convergence of a single fit: one panel for each curve of the history.

    A cost with negative values, or only zeros, has a linear axis. Epochs without a finite value leave a gap.

    **Arguments:**

    - `history`: of a [`Fit`][vertax.Fit].
    - `figure`: an empty figure to draw in, so that no window is opened; by default a new one.

    **Returns:** the axes of the panels.

    **Raises:** `ValueError` for the history of a batch: take that of a member.
    """
    checked("history", history.cost, len(history.cost))
    columns = history.columns()
    curves = {name: columns[name] for name in _CURVES if name in columns}
    with _style.house_style():
        panels = _style.new_axes(len(curves), width=2.3, height=2.0, figure=figure)
        for panel, (name, curve) in zip(panels, curves.items(), strict=True):
            title, scale = _CURVES[name]
            if np.any(curve < 0) or not np.any(curve > 0):
                scale = "linear"
            # On a logarithmic axis zeros are gaps. A curve of one epoch, or between two gaps, is a point.
            values = np.where(curve > 0, curve, np.nan) if scale == "log" else curve
            panel.plot(
                values, color=_style.SERIES[0], marker="o" if len(curve) < 15 else None, ms=2.5
            )
            panel.set(xlabel="epoch", ylabel=title, yscale=scale)
            if np.issubdtype(curve.dtype, np.integer):
                panel.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
                top = max(1.0, panel.dataLim.y1)  # with only zeros the ticks would be fractions
                panel.set_ylim(-0.03 * top, 1.05 * top)
    return panels
