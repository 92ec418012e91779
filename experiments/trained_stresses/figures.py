"""Pictures of trained stresses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.mesh import Tissue
from vertax.plotting import house_style, new_figure, plot_stress, series_colours


@house_style()
def training(
    tissue: Tissue,
    stresses: Float[np.ndarray, "cells 2 2"],
    trained: Sequence[int],
    errors: Mapping[str, Float[np.ndarray, "numbers tissues epochs"]],
) -> Figure:
    """A trained tissue, how the distance from the target falls, and what is left for each number of cells.

    **Arguments:**

    - `tissue`, `stresses`: the tissue with the stress of its cells.
    - `trained`: numbers of cells that were trained at once.
    - `errors`: distance from the target, relative to the first one, by the rule.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 3, width=2.3)
    plot_stress(tissue, stresses, ax=axes[0])
    for (rule, colour), values in zip(series_colours(errors).items(), errors.values(), strict=True):
        # One curve a number of cells: the fainter, the fewer.
        for i, curve in enumerate(np.nanmedian(values, axis=1)):
            label = rule if i == len(trained) - 1 else None
            axes[1].plot(curve, color=colour, lw=0.8, alpha=(i + 1) / len(trained), label=label)
        best = np.fmin.reduce(values, axis=-1)
        axes[2].plot(trained, np.median(best, axis=1), "o-", ms=3, color=colour, label=rule)
    axes[1].set(xlabel="epoch", ylabel="distance from target, relative", yscale="log")
    axes[2].set(xlabel="trained cells", ylabel="least distance, relative", yscale="log")
    axes[2].set_xscale("log", base=2)
    axes[1].legend()
    return figure
