"""Pictures of the rigidity transition, beginning with the paper's Figure 3g, left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.plotting import INK, SERIES, house_style, new_figure, series_colours

REFERENCE = 3.81
"""The transition of disordered tissues, from D. Bi et al. 2015."""


class Curve(NamedTuple):
    """Fractions of tissues at zero energy, and energies, with what was fitted to them."""

    name: str
    fraction: Float[np.ndarray, " values"]
    centre: float
    width: float
    """Of the logistic curve through the fractions."""
    root_energy: Float[np.ndarray, " values"]
    """Mean root of the energy per cell."""
    onset: tuple[float, float] | None
    """Where the line through it ends, and its inverse slope."""


@house_style()
def transition(
    shape_factors: Float[np.ndarray, " values"],
    curves: Sequence[Curve],
    shapes: Float[np.ndarray, "values tissues"],
    modes: Float[np.ndarray, "values some"],
) -> Figure:
    """Zero-energy states, energies, observed shapes and zero modes against the shape factor.

    **Arguments:**

    - `shape_factors`: target shape factors.
    - `curves`: fractions at zero energy, and energies, after more and more driving.
    - `shapes`: mean observed shape factor of each tissue at the end.
    - `modes`: number of zero modes of some tissues; none leaves the panel out.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 4 if modes.size else 3, width=2.2)
    colours = series_colours(curve.name for curve in curves).values()
    fine = np.linspace(shape_factors.min(), shape_factors.max(), 400)
    for curve, colour in zip(curves, colours, strict=True):
        axes[0].plot(shape_factors, curve.fraction, "o", ms=3, color=colour, label=curve.name)
        if np.isfinite(curve.centre):
            z = np.clip((fine - curve.centre) / curve.width, -50, 50)
            axes[0].plot(fine, 1 / (1 + np.exp(-z)), color=colour, lw=1)
    axes[0].axvline(REFERENCE, color=INK, lw=0.7, ls=":")
    axes[0].set(ylabel="fraction at zero energy", ylim=(-0.03, 1.03))
    axes[0].legend(loc="upper left")
    for curve, colour in zip(curves, colours, strict=True):
        axes[1].plot(shape_factors, curve.root_energy, "o", ms=3, color=colour)
        if curve.onset is not None:
            onset, width = curve.onset
            axes[1].plot(
                [shape_factors[0], onset],
                [(onset - shape_factors[0]) / width, 0],
                color=colour,
                lw=1,
            )
    axes[1].axvline(REFERENCE, color=INK, lw=0.7, ls=":")
    axes[1].set_ylabel("root of energy per cell")
    ends = [shape_factors.min(), shape_factors.max()]
    axes[2].plot(ends, ends, color=INK, lw=0.7, ls=":")
    mean, deviation = shapes.mean(axis=1), shapes.std(axis=1)
    axes[2].errorbar(shape_factors, mean, deviation, fmt="o", ms=3, lw=0.8, color=SERIES[1])
    axes[2].set(ylabel="mean observed shape factor")
    if modes.size:
        mean, deviation = modes.mean(axis=1), modes.std(axis=1)
        axes[3].errorbar(shape_factors, mean, deviation, fmt="o", ms=3, lw=0.8, color=SERIES[1])
        axes[3].set(ylabel="zero modes of a tissue")
    for ax in axes:
        ax.set_xlabel("target shape factor $p_0$")

    return figure
