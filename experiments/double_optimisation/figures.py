"""Pictures of where tissues turn fluid, before and after tuning."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.plotting import INK, SERIES, house_style, new_figure


@house_style()
def transition(
    shape_factors: Float[np.ndarray, " values"],
    energies: Mapping[
        str, tuple[Float[np.ndarray, "values tissues"], Float[np.ndarray, "values tissues"]]
    ],
    onsets: Mapping[str, tuple[float, float]],
) -> Figure:
    """The root of the energy against the shape factor, with factors as drawn and tuned.

    **Arguments:**

    - `shape_factors`: mean target shape factors.
    - `energies`: energies per cell with factors as drawn, and tuned, by what is tuned.
    - `onsets`: where they would vanish.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, len(energies), width=2.3)
    for ax, (name, pair) in zip(axes, energies.items(), strict=True):
        for label, values, onset, colour in zip(
            ("as drawn", "tuned"), pair, onsets[name], SERIES, strict=False
        ):
            roots = np.sqrt(np.maximum(values, 0))
            each = np.repeat(shape_factors, roots.shape[1])
            ax.plot(each, roots.ravel(), ".", ms=2, color=colour, alpha=0.4)
            ax.plot(shape_factors, roots.mean(axis=1), color=colour, label=label)
            if np.isfinite(onset):
                ax.axvline(onset, color=colour, lw=0.7, ls=":")
        ax.axhline(0, color=INK, lw=0.5)
        ax.set(title=f"tuned: {name}", xlabel="mean target shape factor")
    axes[0].set_ylabel("root of energy per cell")
    axes[0].legend()
    return figure
