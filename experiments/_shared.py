"""Functions that several experiments use."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vertax import plotting


def columns(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The table of some rows: an array per column, in the order of the first row."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


FLUID = 3.81
"""Target shape factor at which disordered tissues become fluid (Bi et al. 2015, doi:10.1038/nphys3471)."""
HEXAGON = float(np.sqrt(8 * np.sqrt(3)))
"""Perimeter of a regular hexagon of area 1, and target at which the hexagonal lattice becomes fluid."""


def plot_tensions(panels: dict[str, Any], bounds: tuple[float, float], widths: Sequence[float]) -> Any:
    """A figure with tissues in the colours of their tensions, and empty axes to their right.

    `panels` has a tissue and the tensions of its edges by title, `widths` those of the empty axes in inches.
    """
    all_widths, n = [2.3] * len(panels) + list(widths), len(panels)
    figure, (axes,) = plotting.new_figure(1, len(all_widths), width=all_widths, height=2.5, room=0.7)
    tissues = {title: tissue for title, (tissue, _) in panels.items()}
    tensions = [values for _, values in panels.values()]
    options: Any = {"edge_vmin": bounds[0], "edge_vmax": bounds[1], "edge_label": r"tension $\gamma$"}
    plotting.plot_tissues(tissues, edges=tensions, axes=axes[:n], **options)
    return figure, axes[n:]
