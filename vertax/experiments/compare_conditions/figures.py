"""Pictures of the comparison of two conditions, in the layout of the paper's Figure 3g."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vertax.experiments import _figures
from vertax.plotting import _style, plot_tissue
from vertax.plotting._tissue import draw_image

_COLOURS = {"stiff": _style.SERIES[0], "fluid": _style.SERIES[1]}


def conditions(found: Sequence[Any]) -> Figure:
    """Inferred against true shape factors, and both conditions, at each signal-to-noise ratio.

    **Arguments:**

    - `found`: images with `condition`, `snr`, `true`, `inferred` and `deviation`.

    **Returns:** the figure.
    """
    ratios = list(dict.fromkeys(image.snr for image in found))
    values = np.concatenate([x for image in found for x in (image.true, image.inferred)])
    ends = np.percentile(values, [0.5, 99.5]) + np.array([-0.05, 0.05])
    with _style.house_style():
        layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06)
        figure = Figure(figsize=(2.4 * len(ratios), 4.6), layout=layout)
        axes = figure.subplots(2, len(ratios), squeeze=False)
        for (scatter, box), snr in zip(axes.T, ratios, strict=True):
            own = [image for image in found if image.snr == snr]
            scatter.plot(ends, ends, color=_style.INK, lw=0.7, ls=(0, (4, 3)), zorder=1)
            cells = {}
            for kind, colour in _COLOURS.items():
                images = [image for image in own if image.condition == kind]
                if not images:
                    continue
                true, inferred, deviation = (
                    np.concatenate([getattr(i, name) for i in images])
                    for name in ("true", "inferred", "deviation")
                )
                scatter.errorbar(
                    true, inferred, deviation, fmt="o", ms=2.5, lw=0.4, color=colour, label=kind
                )
                cells[kind] = inferred
            scatter.set(xlim=ends, ylim=ends, title=f"SNR {snr:g}")
            scatter.set(xlabel="true $p_0$", ylabel="inferred $p_0$")
            scatter.set_aspect("equal")
            _figures.boxes(box, cells, _COLOURS, log=False)
            box.set(ylabel="inferred $p_0$", ylim=ends)
        axes[0, 0].legend(loc="upper left")
    return figure


def images(pictures: Mapping[str, tuple[np.ndarray, Any, Any]]) -> Figure:
    """The first image of each kind, with the fitted mesh over it.

    **Arguments:**

    - `pictures`: pixels, segmentation and fit by title.

    **Returns:** the figure.
    """
    columns = max(1, (len(pictures) + 1) // 2)
    with _style.house_style():
        layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03)
        figure = Figure(figsize=(2.3 * columns * 2, 4.9), layout=layout)
        axes = figure.subplots(2, 2 * columns, squeeze=False)
        for ax in axes.ravel():
            ax.set_axis_off()
        for k, (title, (pixels, found, outcome)) in enumerate(pictures.items()):
            raw, fitted = axes[k % 2, 2 * (k // 2) : 2 * (k // 2) + 2]
            draw_image(raw, pixels, found.pixel_size)
            plot_tissue(
                outcome.tissue, ax=fitted, image=pixels, pixel_size=found.pixel_size, linewidth=0.9
            )
            raw.set_title(title)
            fitted.set_title("fitted mesh")
    return figure
