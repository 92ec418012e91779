"""Pictures of an inference: what was hidden, what was found, and the way there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vertax.fitting import History
from vertax.mesh import Tissue
from vertax.plotting import _style, plot_history, plot_recovery, plot_tissue
from vertax.plotting._tissue import draw_image

Cells = Float[Array | np.ndarray, " cells"]


def tissues(
    panels: Mapping[str, tuple[Tissue, Cells]], *, label: str, cmap: str = "viridis"
) -> Figure:
    """Tissues side by side, their cells coloured on one scale.

    **Arguments:**

    - `panels`: tissue and values of its cells by the title of the panel.
    - `label`: of the colour bar.
    - `cmap`: the colour map.

    **Returns:** the figure.
    """
    everything = np.concatenate([np.asarray(values) for _, values in panels.values()])
    low, high = everything.min(), everything.max()
    with _style.house_style():
        figure, axes = new_figure(len(panels), width=2.5, height=2.5, room=0.7)
        for ax, (title, (tissue, values)) in zip(axes, panels.items(), strict=True):
            plot_tissue(tissue, values, ax=ax, vmin=low, vmax=high, cmap=cmap, colorbar=False)
            ax.set_title(title)
        figure.colorbar(axes[-1].collections[0], ax=axes, label=label, shrink=0.85, aspect=25)
    return figure


def convergence(history: History) -> Figure:
    """The curves of a fit over its epochs.

    **Arguments:**

    - `history`: of the fit.

    **Returns:** the figure.
    """
    curves = history.columns()
    with _style.house_style():
        figure, axes = new_figure(3 + ("relative_error" in curves), width=2.3, height=2.0)
        plot_history(history, axes=axes)
    return figure


def recovery(truth: Cells, inferred: Cells, initial: Cells, *, name: str) -> Figure:
    """Inferred against true parameters.

    **Arguments:**

    - `truth`, `inferred`, `initial`: the parameters.
    - `name`: what they are called.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, (ax,) = new_figure(1, width=3.0, height=3.0)
        plot_recovery(truth, inferred, initial, ax=ax, name=name)
    return figure


def band(ax: Axes, curves: np.ndarray, label: str, colour: str) -> None:
    """Curves of replicates by epoch: their mean, and one standard deviation, of the logarithm.

    **Arguments:**

    - `ax`: where to draw.
    - `curves`: positive numbers, shape `(epochs, replicates)`.
    - `label`, `colour`: of the mean.
    """
    logarithm = np.log(np.maximum(curves, 1e-300))
    mean, deviation = logarithm.mean(axis=1), logarithm.std(axis=1)
    epochs = np.arange(len(curves))
    ax.plot(epochs, np.exp(mean), color=colour, label=label, lw=1)
    ax.fill_between(
        epochs, np.exp(mean - deviation), np.exp(mean + deviation), color=colour, alpha=0.15, lw=0
    )


def boxes(
    ax: Axes, values: Mapping[str, np.ndarray], colours: Mapping[str, str], *, log: bool = True
) -> None:
    """A box of each group, and all its points.

    **Arguments:**

    - `ax`: where to draw.
    - `values`, `colours`: numbers and colour by the name of the group.
    - `log`: on a logarithmic axis.
    """
    data = [np.asarray(v, float) for v in values.values()]
    if log:
        data = [np.maximum(points, 1e-17) for points in data]
    drawn = ax.boxplot(data, widths=0.5, showfliers=False, medianprops={"color": _style.INK})
    for k, (name, points) in enumerate(zip(values, data, strict=True), start=1):
        ax.plot(np.full(len(points), k), points, ".", ms=4, color=colours[name], zorder=3)
    for line in (*drawn["boxes"], *drawn["whiskers"], *drawn["caps"]):
        line.set(color="0.5", lw=0.8)
    ax.set_xticks(range(1, len(values) + 1), list(values))
    if log:
        ax.set_yscale("log")


def overlays(
    image: Float[np.ndarray, "rows columns"],
    panels: Mapping[str, Tissue | None],
    *,
    pixel_size: float,
    upright: bool = False,
) -> Figure:
    """An image side by side with itself under meshes.

    **Arguments:**

    - `image`: the image; its first row and column begin at x = 0 and y = 0.
    - `panels`: the tissue to draw over the image, or None for the image alone, by the title of the
        panel.
    - `pixel_size`: side of a pixel, in units of length.
    - `upright`: draw y upwards, as pictures of tissues are, and not downwards, as images are.

    **Returns:** the figure.
    """
    rows, columns = image.shape
    with _style.house_style():
        figure, axes = new_figure(len(panels), width=2.6, height=2.6 * rows / columns + 0.2)
        for ax, (title, tissue) in zip(axes, panels.items(), strict=True):
            if tissue is None:
                draw_image(ax, image, pixel_size)
                ax.set_axis_off()
            else:
                plot_tissue(tissue, ax=ax, image=image, pixel_size=pixel_size, linewidth=0.9)
            ax.set_title(title)
            if upright:
                ax.invert_yaxis()
    return figure


def cells_on_image(
    image: Float[np.ndarray, "rows columns"],
    tissue: Tissue,
    values: Cells,
    mask: Bool[np.ndarray, " cells"],
    *,
    pixel_size: float,
    label: str,
) -> Figure:
    """Some cells of a tissue, coloured, over the image that they come from.

    **Arguments:**

    - `image`: the image; its first row and column begin at x = 0 and y = 0.
    - `tissue`: the tissue.
    - `values`: of the cells.
    - `mask`: which cells to draw.
    - `pixel_size`: side of a pixel, in units of length.
    - `label`: of the colour bar.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, (ax,) = new_figure(1, width=4.6, height=3.9)
        plot_tissue(
            tissue, values, ax=ax, mask=mask, image=image, pixel_size=pixel_size, label=label
        )
    return figure


def new_figure(
    n: int, *, width: float, height: float, room: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """A figure of `n` axes side by side, each `width` × `height` inches, which no window shows.

    **Arguments:**

    - `n`: number of axes.
    - `width`, `height`: of each, in inches.
    - `room`: more width on the right, for a colour bar.

    **Returns:** the figure and its axes.
    """
    # Not pyplot: it keeps every figure open, and on a screen would open windows.
    layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
    figure = Figure(figsize=(n * width + room, height), layout=layout)
    return figure, list(figure.subplots(1, n, squeeze=False)[0])
