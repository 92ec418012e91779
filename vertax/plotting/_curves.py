"""Curves of a fit: how it converged and what it found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Real
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from vertax.fitting import History
from vertax.plotting import _style

# What a history may hold, in the order of the panels: its name there, and the scale of its axis.
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
    label: str | None = None,
) -> list[Axes]:
    """Draw how a fit converged: one panel for each curve that the history holds.

    Curves are drawn on a logarithmic axis; where a curve has negative values or nothing but zeros
    (a number of transitions, say), on a linear one. Epochs without a finite value leave a gap.

    **Arguments:**

    - `history`: of a [`Fit`][vertax.Fit], or values per epoch under the names `cost`, and if there
        `relative_error`, `max_force` and `num_t1`; other entries are left out.
    - `axes`: where to draw, one for each panel, to compare several fits; by default a new figure.
    - `label`: name of this fit in the legend.

    **Returns:** the axes of the panels.

    **Raises:**

    - `ValueError` if the history has no `cost`, if its curves differ in length, or if the number of
        `axes` is not that of the panels.
    """
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
        panels = _style.new_axes(len(curves), width=2.3, height=2.0) if axes is None else list(axes)
        for panel, (name, curve) in zip(panels, curves.items(), strict=True):
            colour = _style.SERIES[len(panel.lines) % len(_style.SERIES)]
            epochs = np.arange(len(curve))
            title, scale = _CURVES[name]
            logarithmic = scale == "log" and not np.any(curve < 0) and np.any(curve > 0)
            # Zeros have no place on a logarithmic axis: gaps, like missing values.
            values = np.where(curve > 0, curve, np.nan) if logarithmic else curve
            # A curve of one epoch, or between two gaps, shows as points only.
            few = {"marker": "o", "markersize": 2.5} if len(curve) < 15 else {}
            panel.plot(epochs, values, color=colour, label=label, **few)
            panel.set_yscale("log" if logarithmic else "linear")
            if np.issubdtype(np.asarray(history[name]).dtype, np.integer):
                panel.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
                top = max(1.0, panel.dataLim.y1)  # nothing but zeros would be an axis of fractions
                panel.set_ylim(-0.03 * top, 1.05 * top)
            panel.set_xlabel("epoch")
            panel.set_ylabel(title)
        if label is not None:
            panels[0].legend()
    return panels


def plot_recovery(
    true: Real[Array | np.ndarray, " ..."],
    inferred: Real[Array | np.ndarray, " ..."],
    initial: Real[Array | np.ndarray, " ..."] | None = None,
    *,
    ax: Axes | None = None,
    name: str = "parameter",
) -> Axes:
    r"""Scatter inferred against true parameters, with the diagonal of a perfect recovery.

    Annotated with Pearson's correlation r (where both vary) and the mean relative error
    $\langle|\hat\theta_i-\theta_i|/|\theta_i|\rangle$ (where no true parameter is zero).

    **Arguments:**

    - `true`, `inferred`: the parameters; they may have any unit, the same.
    - `initial`: what the fit started from, drawn pale.
    - `ax`: the axes to draw in; by default those of a new figure.
    - `name`: what the parameter is called on the axes.

    **Returns:** the axes.

    **Raises:**

    - `ValueError` if the arguments are empty or differ in length.
    """
    true, inferred = np.asarray(true, float), np.asarray(inferred, float)
    initial = None if initial is None else np.asarray(initial, float)
    for argument, values in (("inferred", inferred), ("initial", initial)):
        if values is not None and values.shape != true.shape:
            raise ValueError(
                f"Argument `{argument}` must have the shape of `true`, {true.shape}, but has "
                f"{values.shape}."
            )
    if true.ndim != 1 or true.size == 0:
        raise ValueError(
            f"Argument `true` must hold a list of at least one parameter, but has shape "
            f"{true.shape}."
        )
    with _style.house_style():
        if ax is None:
            (ax,) = _style.new_axes(width=2.6, height=2.6)
        blue, vermilion = _style.SERIES[:2]
        size = float(np.clip(400 / true.size, 3, 16))
        if initial is not None:
            ax.scatter(true, initial, s=size, color="0.75", lw=0, label="initial", zorder=2)
        ax.scatter(true, inferred, s=size, color=blue, lw=0, label="inferred", zorder=3)
        points = np.concatenate([true, inferred] + ([] if initial is None else [initial]))
        finite = points[np.isfinite(points)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        ends = np.array([low - margin, high + margin])
        ax.plot(ends, ends, color=vermilion, lw=0.8, ls=(0, (4, 3)), zorder=1)
        ax.set(xlim=ends, ylim=ends, xlabel=f"true {name}", ylabel=f"inferred {name}")
        ax.set_aspect("equal")
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.yaxis.set_major_locator(MaxNLocator(5))
        ax.text(
            0.04,
            0.97,
            _agreement(true, inferred),
            transform=ax.transAxes,
            va="top",
            ha="left",
            size=7,
        )
        if initial is not None:
            ax.legend(loc="lower right", handletextpad=0.1, borderaxespad=0.2)
    return ax


def _agreement(true: np.ndarray, inferred: np.ndarray) -> str:
    """Pearson's r and the mean relative error, as far as they are defined."""
    lines = []
    # Constant up to rounding has no correlation, and dividing by its tiny variance would make one
    # up.
    varies = [np.ptp(x) > 1e-12 * np.abs(x).max() for x in (true, inferred)]
    if all(varies):
        lines.append(f"$r$ = {np.corrcoef(true, inferred)[0, 1]:.4f}")
    if np.all(true != 0):
        error = float(np.mean(np.abs((inferred - true) / true)))
        lines.append(f"mean relative error = {100 * error:.2g} %")
    return "\n".join(lines)
