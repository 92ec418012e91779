"""Pictures of convergent extension, in the layout of the paper's Figure 4b."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import INK, house_style, new_figure, plot_tissues, series_colours


@house_style()
def elongation(
    panels: Mapping[str, tuple[Tissue, np.ndarray]],
    bounds: tuple[float, float],
    targets: Float[np.ndarray, " targets"],
    ratios: Mapping[int, Float[np.ndarray, "targets replicates"]],
) -> Figure:
    """Tissues before and after, and the error against the target.

    **Arguments:**

    - `panels`: tissue and tensions of its edges by the title of the panel.
    - `bounds`: of the tensions.
    - `targets`: aspect ratios asked for.
    - `ratios`: aspect ratios reached by the number of cells.

    **Returns:** the figure.
    """
    n = len(panels)
    figure, (axes,) = new_figure(1, n + 2, width=[2.3] * n + [2.7] * 2, height=2.5, room=0.7)
    plot_tissues(
        {title: tissue for title, (tissue, _) in panels.items()},
        edges=[values for _, values in panels.values()],
        axes=axes[:n],
        edge_vmin=bounds[0],
        edge_vmax=bounds[1],
        edge_label=r"tension $\gamma$",
    )
    _against_target(axes[n], axes[n + 1], targets, ratios)
    return figure


def _against_target(
    reached: Axes, error: Axes, targets: np.ndarray, ratios: Mapping[int, np.ndarray]
) -> None:
    reached.plot(targets, targets, color=INK, ls=":", lw=0.8)
    step = 0.012 * (np.ptp(targets) or 1.0)
    colours = series_colours(f"{n_cells} cells" for n_cells in ratios)
    for number, ((name, colour), values) in enumerate(
        zip(colours.items(), ratios.values(), strict=True)
    ):
        # Side by side: where all is well, all points are the same.
        at = targets + step * (number - (len(ratios) - 1) / 2)
        style: Any = {"color": colour, "label": name, "ms": 3, "lw": 0.8, "capsize": 2}
        squared = (values - targets[:, None]) ** 2
        reached.errorbar(at, values.mean(1), values.std(1), fmt="o", **style)
        mean, deviation = squared.mean(1), squared.std(1)
        # On a logarithmic axis a bar may not go down to zero.
        below = np.minimum(deviation, 0.9 * mean)
        error.errorbar(at, mean, [below, deviation], fmt="o-", **style)
    reached.set(xlabel="target aspect ratio", ylabel="aspect ratio reached")
    error.set(xlabel="target aspect ratio", ylabel="squared error", yscale="log")
    reached.legend()
