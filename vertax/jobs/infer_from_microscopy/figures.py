"""Pictures of an inference from microscopy: meshes over the image, and what the cells are like."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import plot_tissue, plot_tissues, scale_bar


def overlays(
    image: Float[np.ndarray, "rows columns"], panels: Mapping[str, Tissue], *, pixel_size: float
) -> Figure:
    """Meshes over the image.

    **Arguments:**

    - `image`: the image; its first row and column begin at x = 0 and y = 0.
    - `panels`: the tissue by the title of the panel.
    - `pixel_size`: side of a pixel, in units of length.

    **Returns:** the figure.
    """
    figure = Figure()
    axes = plot_tissues(panels, figure=figure, image=image, pixel_size=pixel_size, linewidth=0.9)
    scale_bar(axes[0], "pixels", unit_length=pixel_size)
    return figure


def cells_on_image(
    image: Float[np.ndarray, "rows columns"],
    tissue: Tissue,
    values: Float[Array | np.ndarray, " cells"],
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
    figure = Figure()
    ax = plot_tissue(
        tissue,
        values,
        figure=figure,
        mask=mask,
        image=image,
        pixel_size=pixel_size,
        label=label,
    )
    scale_bar(ax, "pixels", unit_length=pixel_size)
    return figure
