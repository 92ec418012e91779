"""Pictures of storage and loss moduli."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.figure import Figure

from vertax.plotting import SERIES, house_style, new_figure


@house_style()
def moduli(
    frequencies: Float[np.ndarray, " frequencies"],
    measured: Mapping[str, Complex[np.ndarray, " frequencies"]],
    expected: Mapping[str, Complex[np.ndarray, " frequencies"]],
) -> Figure:
    """Storage and loss modulus against frequency, a panel for each tissue.

    **Arguments:**

    - `frequencies`: angular frequencies.
    - `measured`: complex moduli by the name of the tissue.
    - `expected`: what they should be.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, len(measured), width=2.6)
    for ax, (name, found) in zip(axes, measured.items(), strict=True):
        parts = (("storage $G'$", np.real), ("loss $G''$", np.imag))
        for colour, (label, part) in zip(SERIES, parts, strict=False):
            ax.plot(frequencies, part(found), "o", ms=3.5, color=colour, label=label)
            ax.plot(frequencies, part(expected[name]), color=colour, lw=0.9)
        ax.set(xscale="log", xlabel=r"frequency $\omega$", ylabel="modulus", title=name)
        ax.set_ylim(0, None)
    axes[0].legend()
    return figure
