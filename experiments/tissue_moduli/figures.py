"""Pictures of moduli against the target shape factor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from experiments.rigidity_transition.figures import REFERENCE
from vertax.plotting import INK, SERIES, house_style, new_figure

from ._branch import Branch

# Of the regular hexagon, at which the ordered lattice softens.
HEXAGON = float(np.sqrt(8 * np.sqrt(3)))


@house_style()
def moduli(
    shape_factors: Float[np.ndarray, " values"],
    shear: Float[np.ndarray, "values tissues"],
    means: Mapping[str, Float[np.ndarray, " values"]],
    solid: Float[np.ndarray, " values"],
) -> Figure:
    """Shear moduli, bulk modulus and tension, and the share of solid tissues, against the shape factor.

    **Arguments:**

    - `shape_factors`: target shape factors.
    - `shear`: relaxed shear modulus of each tissue.
    - `means`: mean `shear`, `affine`, `bulk` and `tension` at each shape factor.
    - `solid`: share of solid tissues.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 3, width=2.3)
    each = np.repeat(shape_factors, shear.shape[1])
    axes[0].plot(each, shear.ravel(), ".", ms=2, color=SERIES[0], alpha=0.4)
    axes[0].plot(shape_factors, means["shear"], color=SERIES[0], label="relaxed")
    axes[0].plot(shape_factors, means["affine"], color=SERIES[1], label="affine")
    # With E = (A - 1)² + (P - p0)² the stiffness K_P is 2.
    lattice = np.maximum(2 * HEXAGON * (HEXAGON - shape_factors) / 4, 0)
    axes[0].plot(shape_factors, lattice, "--", color=INK, lw=0.8, label="hexagons")
    axes[0].set(ylabel="shear modulus", ylim=(0, None))
    axes[0].legend()
    axes[1].plot(shape_factors, means["bulk"], color=SERIES[2], label="bulk modulus")
    axes[1].plot(shape_factors, means["tension"], color=SERIES[3], label="tension")
    axes[1].set(ylabel="energy per area", ylim=(0, None))
    axes[1].legend()
    axes[2].plot(shape_factors, solid, "o-", ms=3, color=SERIES[0])
    axes[2].set(ylabel="share of solid tissues", ylim=(-0.03, 1.03))
    for ax in axes:
        ax.axvline(REFERENCE, color=INK, lw=0.7, ls=":")
        ax.set_xlabel("target shape factor $p_0$")
    return figure


@house_style()
def stiffening(
    pairs: Sequence[tuple[Branch, Branch]], table: Mapping[str, Float[np.ndarray, " tissues"]]
) -> Figure:
    """Stress and modulus of fluid tissues beyond their critical strain, and the factor between them.

    **Arguments:**

    - `pairs`: both ways of each tissue.
    - `table`: `critical_strain`, `centre` and `factor` of each tissue.

    **Returns:** the figure.
    """
    figure, (axes,) = new_figure(1, 3, width=2.3)
    for pair, centre in zip(pairs, table["centre"], strict=True):
        for way, middle in zip(pair, (centre, -centre), strict=True):
            axes[0].plot(way.strains, way.stresses, color=SERIES[0], lw=0.5, alpha=0.5)
            over = 3 * way.stresses / (way.strains - middle)
            excess = way.moduli - way.line(middle)[1]
            axes[1].plot(over, excess, color=SERIES[0], lw=0.5, alpha=0.5)
    axes[0].set(xlabel="shear strain", ylabel="shear stress", ylim=(0, None))
    top = min(axes[1].get_xlim()[1], axes[1].get_ylim()[1])
    axes[1].plot([0, top], [0, top], color=INK, lw=0.8, ls="--")
    axes[1].set(xlabel=r"$3\,\tau / (\gamma - \gamma_0)$", ylabel=r"excess modulus $G - \Delta G$")
    axes[2].plot(table["critical_strain"], table["factor"], "o", ms=3, color=SERIES[0])
    axes[2].axhline(3, color=INK, lw=0.8, ls="--")
    axes[2].set(xlabel=r"critical strain $\gamma_c$", ylim=(0, 6))
    axes[2].set_ylabel(r"factor $(\gamma - \gamma_0) (G - \Delta G) / \tau$")
    return figure
