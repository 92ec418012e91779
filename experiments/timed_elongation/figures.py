"""Pictures of a cluster that is led along a course."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import INK, house_style, new_figure, plot_tissues, series_colours


@house_style()
def course(
    panels: Mapping[str, tuple[Tissue, np.ndarray]],
    bounds: tuple[float, float],
    times: Float[np.ndarray, " times"],
    asked: Float[np.ndarray, " times"],
    ratios: Mapping[str, Float[np.ndarray, " times"]],
) -> Figure:
    """Tissues at some times, and the aspect ratio in time.

    **Arguments:**

    - `panels`: tissue and tensions of its edges by the title of the panel.
    - `bounds`: of the tensions.
    - `times`: when the aspect ratio is asked for.
    - `asked`: the course.
    - `ratios`: what was reached, by the name of the kind of tensions.

    **Returns:** the figure.
    """
    n = len(panels)
    figure, (axes,) = new_figure(1, n + 1, width=[2.2] * n + [3.0], height=2.5, room=0.7)
    plot_tissues(
        {title: tissue for title, (tissue, _) in panels.items()},
        edges=[values for _, values in panels.values()],
        axes=axes[:n],
        edge_vmin=bounds[0],
        edge_vmax=bounds[1],
        edge_label=r"tension $\gamma$",
    )
    axes[n].plot(times, asked, "o:", ms=3, color=INK, lw=0.8, label="asked for")
    for (name, colour), values in zip(series_colours(ratios).items(), ratios.values(), strict=True):
        axes[n].plot(times, values, ".-", color=colour, label=f"{name} tensions")
    axes[n].set(xlabel="time", ylabel="aspect ratio")
    axes[n].legend()
    return figure
