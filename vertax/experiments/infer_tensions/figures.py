"""Pictures of tensions and pressures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vertax.experiments._figures import new_figure
from vertax.initialise import Segmentation
from vertax.mesh import Tissue
from vertax.plotting import _style, plot_tissue


def foam(
    image: Float[np.ndarray, "rows columns"],
    found: Segmentation,
    fitted: Tissue,
    tension: Float[np.ndarray, " edges"],
    pressure: Float[np.ndarray, " cells"],
) -> Figure:
    """The image with the fitted edges, and their tensions and the pressures of the cells.

    **Arguments:**

    - `image`: the segmented image.
    - `found`: the cells found in it.
    - `fitted`: the equilibrium that comes closest.
    - `tension`, `pressure`: its tensions and pressures, relative to the mean tension.

    **Returns:** the figure.
    """
    with _style.house_style():
        rows, columns = image.shape
        height = 3.4 * rows / columns + 0.5
        figure, (left, right) = new_figure(2, width=3.6, height=height, room=1.2)
        plot_tissue(fitted, ax=left, image=image, pixel_size=found.pixel_size)
        left.set_title("edges of the equilibrium, over the image")
        plot_tissue(
            fitted,
            pressure,
            tension,
            ax=right,
            cmap="cividis",
            edge_cmap="magma_r",
            label=r"pressure $p\,\sqrt{\bar A}\,/\,\bar\gamma$",
            edge_label=r"tension $\gamma / \bar\gamma$",
        )
        # As in the image, y points down.
        right.set(xlim=left.get_xlim(), ylim=left.get_ylim())
        right.set_title("tensions and pressures")
    return figure


def recovery(edges: Mapping[str, np.ndarray], cells: Mapping[str, np.ndarray]) -> Figure:
    """Inferred against true tensions and pressures.

    **Arguments:**

    - `edges`, `cells`: the tables of the experiment.

    **Returns:** the figure.
    """
    with _style.house_style():
        figure, (left, right) = new_figure(2, width=2.9, height=2.7)
        _against(left, edges, "tension", r"tension $\gamma / \bar\gamma$")
        _against(right, cells, "pressure", r"pressure $p\,\sqrt{\bar A}\,/\,\bar\gamma$")
    return figure


def _against(ax: Axes, table: Mapping[str, np.ndarray], name: str, label: str) -> None:
    true, inferred = table[f"true_{name}"], table[name]
    ax.errorbar(
        true,
        inferred,
        yerr=table[f"{name}_deviation"],
        fmt="o",
        ms=3,
        lw=0.6,
        color=_style.SERIES[0],
        ecolor="0.7",
    )
    known = np.isfinite(true)
    both = np.concatenate([true[known], inferred[known]])
    ends = [both.min(), both.max()]
    ax.plot(ends, ends, color=_style.INK, lw=0.8, ls=":")
    r = np.corrcoef(true[known], inferred[known])[0, 1]
    ax.set(xlabel=f"true {label}", ylabel=f"inferred {label}", title=f"Pearson $r$ = {r:.3f}")
