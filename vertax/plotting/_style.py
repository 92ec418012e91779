"""The look of all pictures."""

from __future__ import annotations

import contextlib
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

MISSING = "0.85"
"""Faces of cells without a value."""
BLANK = "0.96"
"""Faces when cells are not coloured."""
INK = "0.15"
"""Cell outlines and text."""
HIGHLIGHT = "#ffb000"
"""Membranes over a grey image."""
MARK = "#e8308a"
"""Marked edges: not in viridis, not in inferno, and no grey."""
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Blue, vermilion, green, purple of Okabe and Ito, told apart with any colour vision."""

_STYLE: Any = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 9,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "figure.dpi": 150,
    "savefig.dpi": 300,
}


def house_style() -> contextlib.AbstractContextManager[None]:
    """Matplotlib settings while a picture is made; the user's own are back afterwards."""
    return matplotlib.rc_context(_STYLE)


def new_axes(n: int = 1, *, width: float, height: float) -> list[Axes]:
    """A new figure of `n` axes side by side, each `width` × `height` inches."""
    import matplotlib.pyplot as plt  # here: it picks a window system

    _, axes = plt.subplots(
        1,
        n,
        figsize=(n * width, height),
        layout=ConstrainedLayoutEngine(w_pad=0.06),
        squeeze=False,
    )
    return list(axes[0])


def figure_of(ax: Axes) -> Figure:
    """The figure that `ax` is part of, also inside a subfigure."""
    figure: Any = ax.get_figure(root=True)
    return figure
