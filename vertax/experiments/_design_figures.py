"""Pictures of inverse design, in the layout of the paper's Figure 4."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import PercentFormatter

from vertax.mesh import Tissue
from vertax.plotting import _style, plot_tissue

# Pale enough for dark outlines and coloured edges on top.
_TYPES = ListedColormap(["#f6e3c5", "#9fc8e4", "#b9dfb5", "#e5bcd6"], "cell types")


def mechanics(
    panels: Mapping[str, tuple[Tissue, np.ndarray]],
    observed: np.ndarray,
    targets: np.ndarray,
    wanted: float,
) -> Figure:
    """Tissues before and after, and shape factors over epochs.

    **Arguments:**

    - `panels`: tissue and shape factors of its cells by the title of the panel.
    - `observed`, `targets`: shape factors in equilibrium and of the energy, shape `(epochs, cells)`.
    - `wanted`: the mean to reach.

    **Returns:** the figure.
    """
    everything = np.concatenate([values for _, values in panels.values()])
    limits: dict[str, Any] = {"vmin": everything.min(), "vmax": everything.max()}
    with _style.house_style():
        figure, pictures, right = _layout(len(panels), curves=1)
        for ax, (title, (tissue, values)) in zip(pictures, panels.items(), strict=True):
            plot_tissue(tissue, values, ax=ax, colorbar=False, **limits)
            ax.set_title(f"{title}: mean {values.mean():.2f}")
        figure.colorbar(
            pictures[-1].collections[0],
            ax=pictures,
            label=r"shape factor $P/\sqrt{A}$",
            shrink=0.75,
            aspect=25,
        )
        _shape_factors(right[0], observed, targets, wanted)
    return figure


def _shape_factors(ax: Axes, observed: np.ndarray, targets: np.ndarray, wanted: float) -> None:
    blue, vermilion, *_ = _style.SERIES
    lines = ax.plot(targets, color="0.75", lw=0.5)
    lines[0].set_label("$p^0$ of a cell")
    ax.axhline(wanted, color=_style.INK, ls=":", lw=0.8, label="wanted")
    ax.plot(observed.mean(axis=1), color=blue, label="mean in equilibrium")
    # Where both agree, both show.
    ax.plot(targets.mean(axis=1), color=vermilion, ls=(0, (3, 3)), lw=0.8, label="mean $p^0$")
    ax.set(xlabel="epoch", ylabel="shape factor")
    # Above: the curves of the cells are everywhere.
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, columnspacing=1.0)


def elongation(
    panels: Mapping[str, tuple[Tissue, np.ndarray]],
    bounds: tuple[float, float],
    targets: np.ndarray,
    ratios: Mapping[int, np.ndarray],
) -> Figure:
    """Tissues before and after, and the error against the target.

    **Arguments:**

    - `panels`: tissue and tensions of its edges by the title of the panel.
    - `bounds`: of the tensions.
    - `targets`: aspect ratios asked for.
    - `ratios`: aspect ratios reached by the number of cells, shape `(targets, replicates)`.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, pictures, (reached, error) = _layout(len(panels), curves=2)
        for ax, (title, (tissue, values)) in zip(pictures, panels.items(), strict=True):
            _with_tensions(ax, tissue, values, bounds)
            ax.set_title(title)
        _tension_bar(figure, pictures)
        reached.plot(targets, targets, color=_style.INK, ls=":", lw=0.8)
        step = 0.012 * (np.ptp(targets) or 1.0)
        for number, (n_cells, values) in enumerate(ratios.items()):
            # Side by side: where all is well, all points are the same.
            at = targets + step * (number - (len(ratios) - 1) / 2)
            style: Any = {"color": _style.SERIES[number % 4], "label": f"{n_cells} cells"}
            squared = (values - targets[:, None]) ** 2
            reached.errorbar(
                at, values.mean(1), values.std(1), fmt="o", ms=3, lw=0.8, capsize=2, **style
            )
            mean, deviation = squared.mean(1), squared.std(1)
            # On a logarithmic axis a bar may not go down to zero.
            below = np.minimum(deviation, 0.9 * mean)
            error.errorbar(at, mean, [below, deviation], fmt="o-", ms=3, lw=0.8, capsize=2, **style)
        reached.set(xlabel="target aspect ratio", ylabel="aspect ratio reached")
        error.set(xlabel="target aspect ratio", ylabel="squared error", yscale="log")
        reached.legend()
    return figure


def patterns(
    panels: Mapping[str, tuple[Tissue, np.ndarray, np.ndarray]],
    bounds: tuple[float, float],
    shares: Mapping[str, np.ndarray],
) -> Figure:
    """Tissues before and after, and the heterotypic share over epochs.

    **Arguments:**

    - `panels`: tissue, types of its cells and tensions of its edges by the title of the panel.
    - `bounds`: of the tensions.
    - `shares`: share of heterotypic interfaces by the kind of tissue, shape `(epochs, replicates)`.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, pictures, (right,) = _layout(len(panels), curves=1)
        for ax, (title, (tissue, types, values)) in zip(pictures, panels.items(), strict=True):
            _with_tensions(ax, tissue, values, bounds, types)
            ax.set_title(title)
        _tension_bar(figure, pictures)
        for number, (name, values) in enumerate(shares.items()):
            mean, deviation = values.mean(axis=1), values.std(axis=1)
            colour, epochs = _style.SERIES[number % 4], np.arange(len(values))
            right.plot(epochs, mean, color=colour, label=name)
            right.fill_between(
                epochs, mean - deviation, mean + deviation, color=colour, alpha=0.2, lw=0
            )
        right.axhline(1, color=_style.INK, ls=":", lw=0.8)
        right.set(xlabel="epoch", ylabel=r"heterotypic share of interfaces")
        right.yaxis.set_major_formatter(PercentFormatter(1))
        right.legend(loc="lower right")
    return figure


def _layout(n_pictures: int, *, curves: int) -> tuple[Figure, list[Axes], list[Axes]]:
    """Pictures of tissues on the left, and panels with curves on the right."""
    # Not pyplot: it keeps every figure open, and on a screen would open windows.
    layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
    figure = Figure(figsize=(2.3 * n_pictures + 0.7 + 2.7 * curves, 2.5), layout=layout)
    widths = [2.3] * n_pictures + [2.4] * curves
    axes = list(figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0])
    return figure, axes[:n_pictures], axes[n_pictures:]


def _with_tensions(
    ax: Axes,
    tissue: Tissue,
    values: np.ndarray,
    bounds: tuple[float, float],
    types: np.ndarray | None = None,
) -> None:
    low, high = bounds
    plot_tissue(
        tissue,
        types,
        values,
        ax=ax,
        cmap=_TYPES,
        vmin=-0.5,
        vmax=_TYPES.N - 0.5,
        edge_vmin=low,
        edge_vmax=high,
        colorbar=False,
    )


def _tension_bar(figure: Figure, pictures: list[Axes]) -> None:
    lines = pictures[-1].collections[-1]  # the edges are drawn last
    figure.colorbar(lines, ax=pictures, label=r"tension $\gamma$", shrink=0.75, aspect=25)
