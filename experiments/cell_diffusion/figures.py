"""Pictures of the diffusion of cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vertax.plotting import INK, SERIES, house_style, new_figure, series_colours


@house_style()
def diffusion(
    config: Any,
    lags: Float[np.ndarray, " lags"],
    squared: Float[np.ndarray, "speeds values lags"],
    coefficients: Float[np.ndarray, "speeds values"],
    rate: Float[np.ndarray, "speeds values"],
) -> Figure:
    """Mean squared displacements, diffusion and transitions.

    **Arguments:**

    - `config`: of the experiment.
    - `lags`: times between two places of a cell.
    - `squared`: mean squared displacements.
    - `coefficients`: of diffusion, relative to that of a free cell; those below a tenth of the threshold,
        also negative ones, are drawn there.
    - `rate`: transitions per cell and time.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 3, width=2.5)
    middle = len(config.speeds) // 2
    speed = config.speeds[middle]
    shades = series_colours(f"{p0:g}" for p0 in config.shape_factors)
    for (name, colour), values in zip(shades.items(), squared[middle], strict=True):
        axes[0].plot(lags, values, color=colour, label=f"$p_0 = {name}$")
    # A persistent random walk: Bi et al. 2016, eq. 8.
    turn = config.rotational_diffusion
    free = 2 * (speed / turn) ** 2 * (turn * lags + np.expm1(-turn * lags))
    axes[0].plot(lags, free, "--", color=INK, lw=0.8, label="free cell")
    axes[0].set(
        xscale="log", yscale="log", xlabel="time", title=f"$v_0 = {speed:g}$",
        ylabel="mean squared displacement",
    )  # fmt: skip
    axes[0].set_ylim(0.1 * np.nanmin(squared[middle]))
    axes[0].legend(fontsize=6, ncol=2, loc="lower right")
    for number, own in enumerate(config.speeds):
        style: Any = {"color": SERIES[number % len(SERIES)], "ms": 3, "label": f"$v_0 = {own:g}$"}
        shown = np.maximum(coefficients[number], 0.1 * config.threshold)
        axes[1].plot(config.shape_factors, shown, "o-", **style)
        axes[2].plot(config.shape_factors, rate[number], "o-", **style)
    axes[1].axhline(config.threshold, color=INK, lw=0.7, ls=":")
    axes[1].set(yscale="log", xlabel="$p_0$", ylabel="$D_\\mathrm{eff}$ / that of a free cell")
    axes[2].set(xlabel="$p_0$", ylabel="T1s per cell and time")
    axes[2].legend()
    return figure
