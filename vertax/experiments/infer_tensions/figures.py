"""Pictures of tensions and pressures."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Real
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from vertax._base.pixels import pixel_sides
from vertax.inference import InferredTensions
from vertax.initialise import MaskReport
from vertax.plotting import house_style, new_figure, plot_recovery, plot_tissue, scale_bar

# Without the palest end, which would look like no colour at all.
_PRESSURES = ListedColormap(colormaps["Blues"](np.linspace(0.15, 1, 256)), "pressures")


@house_style()
def foam(image: Real[np.ndarray, "rows columns *colours"], found: InferredTensions) -> Figure:
    """The image with the arcs, and a map of tensions and pressures; values not determined are grey.

    On the image the sides of holes are dashed, contacts that the mask does not show are dotted, and a ring
    marks each place where the mask was changed.

    **Arguments:**

    - `image`: a picture of what was segmented, such as a colour for each label.
    - `found`: what was inferred.

    **Returns:** the figure.
    """
    rows, columns = image.shape[:2]
    height = max(3.4 * rows / columns + 0.5, 2.4)
    figure, ((left, right),) = new_figure(1, 2, width=3.6, height=height, room=1.2)
    plot_tissue(found.tissue, ax=left, image=image, pixel_size=found.pixel_size or 1.0)
    left.set_title("arcs over the image")
    scale_bar(left, "pixels", unit_length=pixel_sides(found.pixel_size or 1.0)[0])
    if found.mask_report is not None:
        _draw_report(left, found, found.mask_report)
    plot_tissue(
        found.tissue,
        np.where(found.pressures_determined, found.pressures, np.nan),
        np.where(found.determined, found.tensions, np.nan),
        ax=right,
        cmap=_PRESSURES,
        label=r"pressure $(p - \bar p)\,\sqrt{\bar A}\,/\,\bar\gamma$",
        edge_label=r"tension $\gamma / \bar\gamma$",
    )
    # As in the image, y points down.
    right.set(xlim=left.get_xlim(), ylim=left.get_ylim())
    right.set_title("tensions and pressures")
    return figure


def _draw_report(ax: Axes, found: InferredTensions, report: MaskReport) -> None:
    """Mark holes, contacts that the mask does not show, and places where it was changed."""
    sides = pixel_sides(found.pixel_size or 1.0)
    points = np.asarray(found.tissue.edge_points(jnp.linspace(0.0, 1.0, 13)), float)
    between = np.append(found.labels, 0)[np.asarray(found.tissue.topology.edge_cells)]
    hole = np.append(found.labels == 0, False)[np.asarray(found.tissue.topology.edge_cells)].any(1)
    unshown = report.closed & np.all(between > 0, axis=1)
    for which, style in ((unshown, ":"), (hole, "--")):
        if which.any():
            ax.add_collection(
                LineCollection(list(points[which]), colors="w", linestyles=style, lw=1.5)
            )
    median = np.median(report.pixels)
    for change in report.changes:
        radius = max(
            3.0 * sides.min(), np.sqrt(max(change.pixels, 0.01 * median) * sides.prod() / np.pi)
        )
        place = (sides[0] * change.column, sides[1] * change.row)
        ax.add_patch(Circle(place, radius, fill=False, ec="r", lw=1.0))


@house_style()
def recovery(edges: Mapping[str, np.ndarray], cells: Mapping[str, np.ndarray]) -> Figure:
    """Inferred against true tensions and pressures.

    **Arguments:**

    - `edges`, `cells`: the tables of the experiment.

    **Returns:** the figure.
    """
    figure, ((left, right),) = new_figure(1, 2, width=2.9, height=2.7)
    for ax, table, key, name in (
        (left, edges, "tension", r"tension $\gamma / \bar\gamma$"),
        (right, cells, "pressure", r"pressure $(p - \bar p)\,\sqrt{\bar A}\,/\,\bar\gamma$"),
    ):
        deviation = table[f"{key}_deviation"]
        plot_recovery(table[f"true_{key}"], table[key], deviation=deviation, ax=ax, name=name)
    return figure
