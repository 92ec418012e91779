"""Pictures of the design of patterns of cell types, in the layout of the paper's Figure 4c."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from vertax.mesh import Tissue
from vertax.plotting import INK, house_style, new_figure, plot_band, plot_tissues, series_colours

# Pale enough for dark outlines and coloured edges on top.
_TYPES = ListedColormap(["#f6e3c5", "#9fc8e4", "#b9dfb5", "#e5bcd6"], "cell types")


@house_style()
def patterns(
    panels: Mapping[str, tuple[Tissue, np.ndarray, np.ndarray]],
    bounds: tuple[float, float],
    shares: Mapping[str, Float[np.ndarray, "epochs replicates"]],
) -> Figure:
    """Tissues before and after, and the heterotypic share over epochs.

    **Arguments:**

    - `panels`: tissue, types of its cells and tensions of its edges by the title of the panel.
    - `bounds`: of the tensions.
    - `shares`: share of heterotypic interfaces by the kind of tissue.

    **Returns:** the figure.
    """
    n = len(panels)
    figure, (axes,) = new_figure(1, n + 1, width=[2.3] * n + [2.7], height=2.5, room=0.7)
    types = np.stack([types for _, types, _ in panels.values()])
    tissues = {title: tissue for title, (tissue, *_) in panels.items()}
    plot_tissues(
        tissues,
        types,
        [tensions for *_, tensions in panels.values()],
        axes=axes[:n],
        cmap=_TYPES,
        vmin=-0.5,
        vmax=_TYPES.N - 0.5,
        edge_vmin=bounds[0],
        edge_vmax=bounds[1],
        edge_label=r"tension $\gamma$",
        colorbar="edges",
    )
    right = axes[n]
    for name, colour in series_colours(shares).items():
        plot_band(shares[name], ax=right, label=name, colour=colour)
    right.axhline(1, color=INK, ls=":", lw=0.8)
    right.set(xlabel="epoch", ylabel="heterotypic share of interfaces")
    right.yaxis.set_major_formatter(PercentFormatter(1))
    right.legend(loc="lower right")
    return figure
