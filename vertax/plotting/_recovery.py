"""Inferred against true parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vertax._base.checks import check_shape
from vertax.inference import pearson, relative_error
from vertax.plotting import _style

_DIAGONAL = "recovery"


def plot_recovery(
    true: Real[Array | np.ndarray, " ..."],
    inferred: Real[Array | np.ndarray, " ..."],
    initial: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    deviation: Real[Array | np.ndarray, " ..."] | None = None,
    ax: Axes | None = None,
    figure: Figure | None = None,
    name: str = "parameter",
    label: str | None = None,
    colour: str = _style.SERIES[0],
    marker: str = "o",
) -> Axes:
    r"""Scatter inferred against true parameters, with the diagonal of a perfect recovery.

    Annotated with Pearson's correlation r (where both vary) and the mean relative error
    $\langle|\hat\theta_i-\theta_i|/|\theta_i|\rangle$ (where no true parameter is zero), unless it has a
    `label`. Parameters with a true or inferred value that is not finite are left out.

    ```python
    ax = vx.plot_recovery(true, by_image, label="image")
    vx.plot_recovery(true, by_vertices, label="vertices", colour=vx.plotting.SERIES[1], ax=ax)
    ax.legend()
    ```

    **Arguments:**

    - `true`, `inferred`: the parameters, in the same unit.
    - `initial`: the parameters at the start of the fit, drawn pale.
    - `deviation`: standard deviations of the inferred parameters, drawn as bars.
    - `ax`: the axes to draw in, also for several fits to compare; by default those of a new figure.
    - `figure`: an empty figure to draw in instead; no window is opened.
    - `name`: of the parameter, in the labels of the axes.
    - `label`: name of these parameters in the legend, which the caller then draws.
    - `colour`, `marker`: of the inferred parameters.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if the arguments are empty or differ in length.
    """
    _style.one_of(ax, figure)
    true, inferred = np.asarray(true, float), np.asarray(inferred, float)
    others: dict[str, Any] = {"initial": initial, "deviation": deviation}
    others = {key: None if v is None else np.asarray(v, float) for key, v in others.items()}
    for argument, values in {"inferred": inferred, **others}.items():
        if values is not None:
            remedy = "Give one for each entry of `true`."
            check_shape(argument, values, true.shape, remedy=remedy)
    if true.ndim != 1 or true.size == 0:
        raise ValueError(
            f"Argument `true` must hold a list of at least one parameter, but has shape "
            f"{true.shape}."
        )
    finite = np.isfinite(true) & np.isfinite(inferred)
    true, inferred = true[finite], inferred[finite]
    first, bars = (None if v is None else v[finite] for v in others.values())
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=2.6, height=2.6, figure=figure)
        ends = _ends(ax, np.concatenate([true, inferred] + ([] if first is None else [first])))
        size = float(np.clip(400 / max(true.size, 1), 3, 16))
        if first is not None:
            ax.scatter(true, first, s=size, color="0.75", lw=0, label="initial", zorder=2)
        if bars is not None:
            ax.errorbar(
                true, inferred, bars, fmt="none", ecolor=colour, alpha=0.4, lw=0.6, zorder=2
            )
        of_points = label or "inferred"
        ax.scatter(
            true, inferred, s=size, color=colour, marker=marker, lw=0, label=of_points, zorder=3
        )
        if not any(line.get_gid() == _DIAGONAL for line in ax.lines):
            diagonal = ax.axline(
                (0, 0), slope=1, color=_style.INK, lw=0.7, ls=(0, (4, 3)), zorder=1
            )
            diagonal.set_gid(_DIAGONAL)
        ax.set(xlim=ends, ylim=ends, xlabel=f"true {name}", ylabel=f"inferred {name}")
        ax.set_aspect("equal")
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.yaxis.set_major_locator(MaxNLocator(5))
        if label is None:
            text = _agreement(true, inferred)
            ax.text(0.04, 0.97, text, transform=ax.transAxes, va="top", ha="left", size=7)
            if first is not None:  # above the axes, where it covers no point
                ax.legend(
                    loc="lower right",
                    bbox_to_anchor=(1, 1),
                    ncols=2,
                    handletextpad=0.1,
                    columnspacing=1,
                    borderaxespad=0.2,
                )
    return ax


def _ends(ax: Axes, values: np.ndarray) -> tuple[float, float]:
    """Limits of both axes that show these values and those drawn before."""
    values = values[np.isfinite(values)]
    low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - margin, high + margin
    if any(line.get_gid() == _DIAGONAL for line in ax.lines):
        before = ax.get_xlim()
        low, high = min(low, before[0]), max(high, before[1])
    return float(low), float(high)


def _agreement(true: np.ndarray, inferred: np.ndarray) -> str:
    """Pearson's r and the mean relative error, where they are defined."""
    lines = []
    if true.size and np.isfinite(correlation := pearson(true, inferred)):
        lines.append(f"$r$ = {correlation:.4f}")
    if true.size and np.all(true != 0):
        error = relative_error(true, inferred)
        lines.append(f"mean relative\nerror {100 * error:.2g} %")  # narrow: it covers no points
    return "\n".join(lines)
