"""Pictures of the comparison of two conditions, in the layout of the paper's Figure 3g."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vertax.plotting import (
    SERIES,
    house_style,
    new_figure,
    plot_boxes,
    plot_image,
    plot_recovery,
    plot_tissue,
    same_limits,
    scale_bar,
)

_COLOURS = {"stiff": SERIES[0], "fluid": SERIES[1]}


@house_style()
def conditions(found: Sequence[Any]) -> Figure:
    """Inferred against true shape factors, and both conditions, at each signal-to-noise ratio.

    **Arguments:**

    - `found`: images with `condition`, `snr`, `true`, `inferred` and `deviation`.

    **Returns:** the figure.
    """
    ratios = list(dict.fromkeys(image.snr for image in found))
    figure, axes = new_figure(2, len(ratios))
    for (scatter, box), snr in zip(axes.T, ratios, strict=True):
        cells = {}
        for kind, colour in _COLOURS.items():
            images = [image for image in found if (image.snr, image.condition) == (snr, kind)]
            if not images:
                continue
            true, inferred, deviation = (
                np.concatenate([getattr(i, name) for i in images])
                for name in ("true", "inferred", "deviation")
            )
            options: dict[str, Any] = {"deviation": deviation, "name": "$p_0$", "colour": colour}
            plot_recovery(true, inferred, ax=scatter, label=kind, **options)
            cells[kind] = inferred
        scatter.set_title(f"SNR {snr:g}")
        plot_boxes(cells, ax=box, colours=_COLOURS)
        box.set_ylabel("inferred $p_0$")
    same_limits(axes[0])
    same_limits(axes[1], x=False)
    axes[0, 0].legend(loc="upper left")
    return figure


@house_style()
def images(pictures: Mapping[str, tuple[np.ndarray, Any, Any]]) -> Figure:
    """The first image of each kind, with the fitted mesh over it.

    **Arguments:**

    - `pictures`: pixels, segmentation and fit by title.

    **Returns:** the figure.
    """
    columns = max(1, (len(pictures) + 1) // 2)
    figure, axes = new_figure(2, 2 * columns, width=2.3, height=2.45)
    for ax in axes.ravel():
        ax.set_axis_off()
    for k, (title, (pixels, found, outcome)) in enumerate(pictures.items()):
        raw, fitted = axes[k % 2, 2 * (k // 2) : 2 * (k // 2) + 2]
        size: dict[str, Any] = {"pixel_size": found.pixel_size}
        plot_image(pixels, ax=raw, **size)
        plot_tissue(outcome.tissue, ax=fitted, image=pixels, linewidth=0.9, **size)
        scale_bar(raw, "pixels", unit_length=found.pixel_size)
        raw.set_title(title)
        fitted.set_title("fitted mesh")
    return figure
