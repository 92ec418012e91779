"""The map of inferred tensions and pressures beside their mask."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Integer
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from vertax.initialise import MaskReport
from vertax.plotting._image import label_colours, scale_bar
from vertax.plotting._napari import edge_courses, sides_of_pixels
from vertax.plotting._style import house_style, new_figure
from vertax.plotting._tissue import plot_tissue
from vertax.tensions import InferredTensions

# Without the palest end, which looks like no colour.
PRESSURE_COLOURS = ListedColormap(colormaps["Blues"](np.linspace(0.15, 1, 256)), "pressures")
# Radius in pixels of the smallest ring.
_RADIUS = 3.0


@house_style()
def plot_tensions(
    inferred: InferredTensions, mask: Integer[np.ndarray | Array, "rows columns"], **options: Any
) -> Figure:
    r"""Draw the mask with its arcs, and a map of tensions and pressures, grey where not determined.

    On the mask the sides of holes are dashed, contacts that the mask does not show are dotted, and a red ring
    is around each place where the mask was changed.

    ```python
    vx.plotting.plot_tensions(inferred, mask).savefig("map.png")
    ```

    **Arguments:**

    - `inferred`: the tensions inferred from a mask.
    - `mask`: the label of each pixel.
    - `options`: of the map, as of [`plot_tissue`][vertax.plot_tissue], such as the limits of the colours.

    **Returns:** the figure, which no window shows.

    **Raises:**

    - `ValueError` for tensions of a tissue without an image, and as
        [`label_colours`][vertax.plotting.label_colours].
    """
    width, height = sides_of_pixels(inferred)
    rows, columns = np.shape(mask)
    shape = rows * height / (columns * width)
    figure, ((left, right),) = new_figure(
        1, 2, width=3.6, height=max(3.4 * shape + 0.5, 2.4), room=1.2
    )
    tissue = inferred.tissue
    plot_tissue(tissue, ax=left, image=label_colours(mask), pixel_size=(height, width))
    scale_bar(left, "pixels", unit_length=width)
    left.set_title("arcs over the mask")
    if inferred.mask_report is not None:
        _mark(left, inferred, inferred.mask_report)
    style: dict[str, Any] = {
        "cmap": PRESSURE_COLOURS,
        "label": r"pressure $(p - \bar p) / \bar\gamma$",
        "edge_label": r"tension $\gamma / \bar\gamma$",
    }
    plot_tissue(
        tissue,
        np.where(inferred.pressures_determined, inferred.pressures, np.nan),
        np.where(inferred.determined, inferred.tensions, np.nan),
        ax=right,
        **(style | options),
    )
    # The y axis points down, as in the image.
    right.set(xlim=left.get_xlim(), ylim=left.get_ylim())
    right.set_title("tensions and pressures")
    return figure


def _mark(ax: Axes, inferred: InferredTensions, report: MaskReport) -> None:
    """Mark holes, contacts that the mask does not show, and places where the mask was changed."""
    width, height = sides_of_pixels(inferred)
    points = edge_courses(inferred)
    # The exterior is the last face.
    beside = np.asarray(inferred.tissue.topology.edge_cells)
    hole = np.append(inferred.labels == 0, False)[beside].any(axis=1)
    outline = np.append(np.zeros(len(inferred.labels), bool), True)[beside].any(axis=1)
    for which, style in ((report.closed & ~hole & ~outline, ":"), (hole, "--")):
        lines = LineCollection(list(points[which]), colors="w", linestyles=style, lw=1.5)
        ax.add_collection(lines)
    for change in report.changes:
        radius = np.sqrt(max(change.pixels, 1) * width * height / np.pi)
        radius = max(radius, _RADIUS * max(width, height))
        # Pixel (row, column) covers [column, column + 1] × [row, row + 1].
        place = width * (change.column + 0.5), height * (change.row + 0.5)
        ax.add_patch(Circle(place, radius, fill=False, ec="r", lw=1.0))
