"""Pictures of a synthetic inference: what was hidden, what was found, and the way there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import plot_recovery, plot_tissues, scale_bar

Cells = Float[Array | np.ndarray, " cells"]


def tissues(panels: Mapping[str, tuple[Tissue, Cells]], *, label: str) -> Figure:
    """Tissues side by side.

    **Arguments:**

    - `panels`: tissue and values of its cells by the title of the panel.
    - `label`: of the colour bar.

    **Returns:** the figure.
    """
    figure = Figure()
    shown = {title: tissue for title, (tissue, _) in panels.items()}
    plot_tissues(shown, [values for _, values in panels.values()], figure=figure, label=label)
    return figure


def recovery(truth: Cells, inferred: Cells, initial: Cells, *, name: str) -> Figure:
    """Inferred against true parameters.

    **Arguments:**

    - `truth`, `inferred`, `initial`: the parameters.
    - `name`: what they are called.

    **Returns:** the figure.
    """
    figure = Figure()
    plot_recovery(truth, inferred, initial, figure=figure, name=name)
    return figure


def overlays(
    image: Float[np.ndarray, "rows columns"],
    panels: Mapping[str, Tissue | None],
    *,
    pixel_size: float,
) -> Figure:
    """The image side by side with itself under meshes.

    **Arguments:**

    - `image`: the image; its first row and column begin at x = 0 and y = 0.
    - `panels`: the tissue to draw over the image, or None for the image alone, by the title of the
        panel.
    - `pixel_size`: side of a pixel, in units of length.

    **Returns:** the figure.
    """
    figure = Figure()
    axes = plot_tissues(panels, figure=figure, image=image, pixel_size=pixel_size, linewidth=0.9)
    for ax in axes:
        ax.invert_yaxis()  # upwards, as in the other pictures of these tissues
    scale_bar(axes[0], "pixels", unit_length=pixel_size)
    return figure
