"""Colours, Matplotlib settings and sizes of all figures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

MISSING = "0.85"
"""Faces of cells without a value."""
BLANK = "0.96"
"""Faces when cells are not coloured."""
INK = "0.15"
"""The dark grey of cell outlines, text and reference lines."""
HIGHLIGHT = "#ffb000"
"""Membranes over a grey image."""
MARK = "#e8308a"
"""Marked edges: a colour that is not in viridis or inferno, and not grey."""
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Colours of curves: six of Okabe and Ito, distinguishable with any colour vision, and a grey."""

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


@contextlib.contextmanager
def house_style() -> Iterator[None]:
    """The Matplotlib settings of vertax's figures, for other figures: a context manager or a decorator.

    ```python
    @vx.plotting.house_style()
    def my_figure(energies):
        figure, ((ax,),) = vx.plotting.new_figure()
        ax.plot(energies)
        return figure
    ```

    It restores the previous settings.
    """
    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float | Sequence[float] = 2.4,
    height: float | Sequence[float] = 2.3,
    room: float = 0.0,
) -> tuple[Figure, np.ndarray]:
    """A figure of panels in rows and columns, for a file: it opens no window and needs not be closed.

    ```python
    figure, ((left, right),) = vx.plotting.new_figure(1, 2, width=[3.0, 2.4])
    vx.plot_tissue(tissue, ax=left)
    figure.savefig("tissue.png")
    ```

    **Arguments:**

    - `rows`, `columns`: of panels.
    - `width`: of a panel in inches; or of the panels of each column.
    - `height`: of a panel in inches; or of the panels of each row.
    - `room`: more width on the right in inches, for a colour bar or a legend.

    **Returns:** the figure, and its axes in an array of shape `(rows, columns)`.

    **Raises:**

    - `ValueError` if there are no panels, or if the numbers of widths or heights are wrong.
    """
    if rows < 1 or columns < 1:
        raise ValueError(
            f"Arguments `rows` and `columns` must be positive, but are {rows} and {columns}."
        )
    widths, heights = _sizes("width", width, columns), _sizes("height", height, rows)
    # Not pyplot: it keeps every figure open and opens windows.
    layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
    figure = Figure(figsize=(sum(widths) + room, sum(heights)), layout=layout)
    with house_style():
        axes = figure.subplots(
            rows, columns, width_ratios=widths, height_ratios=heights, squeeze=False
        )
    return figure, axes


def _sizes(name: str, size: float | Sequence[float], n: int) -> list[float]:
    sizes = np.broadcast_to(np.asarray(size, float), n) if np.ndim(size) == 0 else np.asarray(size)
    if sizes.shape != (n,) or not np.all(sizes > 0):
        raise ValueError(
            f"Argument `{name}` must be a positive number of inches, or {n} of them, but is {size}."
        )
    return [float(x) for x in sizes]


def new_axes(
    n: int = 1, *, width: float, height: float, room: float = 0.0, figure: Figure | None = None
) -> list[Axes]:
    """Axes side by side, each `width` × `height` inches, in a new figure of pyplot or filling a given one."""
    size = (n * width + room, height)
    layout = ConstrainedLayoutEngine(w_pad=0.06)
    if figure is None:
        import matplotlib.pyplot as plt  # imported late: it selects a window system

        figure = plt.figure(figsize=size, layout=layout)
    else:
        if figure.axes:
            raise ValueError(
                "Argument `figure` must be empty, but has axes; to draw in some, pass them instead."
            )
        figure.set_size_inches(size)
        figure.set_layout_engine(layout)
    return list(figure.subplots(1, n, squeeze=False)[0])


def one_of(ax: Any, figure: Figure | None, name: str = "ax") -> None:
    """Raise an error if both a figure and axes are given."""
    if ax is not None and figure is not None:
        raise ValueError(f"Arguments `{name}` and `figure` must not both be given.")


def size_of(extent: np.ndarray) -> tuple[float, float]:
    """Width and height of a new figure in inches: 9 square inches for aspect ratios from 1/4 to 4."""
    ratio = float(np.clip(extent[1] / extent[0], 0.25, 4))
    return 3.0 / np.sqrt(ratio), 3.0 * np.sqrt(ratio)


def figure_of(ax: Axes) -> Figure:
    """The figure that `ax` is part of, also inside a subfigure."""
    figure: Any = ax.get_figure(root=True)
    return figure
