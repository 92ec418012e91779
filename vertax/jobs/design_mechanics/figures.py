"""Pictures of the design of shape factors, in the layout of the paper's Figure 4a."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import INK, SERIES, house_style, new_figure, plot_tissues


@house_style()
def mechanics(
    panels: Mapping[str, tuple[Tissue, np.ndarray]],
    observed: Float[np.ndarray, "epochs cells"],
    targets: Float[np.ndarray, "epochs cells"],
    wanted: tuple[str, Float[np.ndarray, " epochs"], float],
) -> Figure:
    """Tissues before and after, and shape factors over epochs; and what is designed, if it is another.

    **Arguments:**

    - `panels`: tissue and shape factors of its cells by the title of the panel.
    - `observed`, `targets`: shape factors in equilibrium and of the energy.
    - `wanted`: what is designed, its values and the one to reach.

    **Returns:** the figure.
    """
    n, (quantity, values, target) = len(panels), wanted
    other = quantity != "shape_factor"
    widths = [2.3] * n + [2.7] * (1 + other)
    figure, (axes,) = new_figure(1, len(widths), width=widths, height=2.5, room=0.7)
    plot_tissues(
        {
            f"{title}: mean {values.mean():.2f}": tissue
            for title, (tissue, values) in panels.items()
        },
        [values for _, values in panels.values()],
        axes=axes[:n],
        label=r"shape factor $P/\sqrt{A}$",
    )
    _shape_factors(axes[n], observed, targets, None if other else target)
    if other:
        axes[-1].plot(values, color=SERIES[2])
        axes[-1].axhline(target, color=INK, ls=":", lw=0.8)
        axes[-1].set(xlabel="epoch", ylabel=quantity.replace("_", " "))
    return figure


def _shape_factors(
    ax: Axes, observed: np.ndarray, targets: np.ndarray, wanted: float | None
) -> None:
    blue, vermilion, *_ = SERIES
    lines = ax.plot(targets, color="0.75", lw=0.5)
    lines[0].set_label("$p^0$ of a cell")
    if wanted is not None:
        ax.axhline(wanted, color=INK, ls=":", lw=0.8, label="wanted")
    ax.plot(observed.mean(axis=1), color=blue, label="mean in equilibrium")
    # Where both agree, both show.
    ax.plot(targets.mean(axis=1), color=vermilion, ls=(0, (3, 3)), lw=0.8, label="mean $p^0$")
    ax.set(xlabel="epoch", ylabel="shape factor")
    # Above: the curves of the cells are everywhere.
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, columnspacing=1.0)
