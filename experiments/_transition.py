"""The transition of a tissue from solid to fluid: from counts, and from the onset of energies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize


class Transition(NamedTuple):
    """Position and width of a transition."""

    centre: float
    """The value of the parameter."""
    width: float
    """Of a logistic curve, see `fit_transition`; or the inverse of a
    slope, see `fit_onset`."""


def fit_transition(
    values: Float[np.ndarray, " values"],
    successes: Float[np.ndarray, " values"],
    trials: int,
) -> Transition:
    r"""The logistic curve $1 / (1 + e^{-(p - p^*) / w})$ that explains counts best (maximum likelihood).

    **Arguments:**

    - `values`: of the parameter, such as target shape factors, where the counts were taken.
    - `successes`: how many of the trials there succeeded, such as tissues without energy.
    - `trials`: number of trials at each.

    **Returns:** the `Transition`; NaN if all trials succeeded, or none. It is
    no steeper than the spacing of the values resolves.

    **Raises:**

    - `ValueError` for fewer than two values, or counts that are not in 0 … `trials`.
    """
    values, successes = np.asarray(values, float), np.asarray(successes, float)
    if len(values) < 2 or successes.shape != values.shape:
        raise ValueError(
            "Arguments `values` and `successes` must have equally many entries, at least 2, but have shapes "
            f"{values.shape} and {successes.shape}."
        )
    if not ((successes >= 0) & (successes <= trials)).all():
        raise ValueError(
            f"Argument `successes` must lie in 0 … {trials} (`trials`), but goes from {successes.min():g} to "
            f"{successes.max():g}."
        )
    if successes.sum() == 0 or successes.sum() == trials * len(successes):
        return Transition(np.nan, np.nan)
    least = 0.1 * np.min(np.diff(np.sort(values)))

    def loss(x: np.ndarray) -> float:
        z = (values - x[0]) / (least + np.exp(x[1]))
        likelihood = successes * -np.logaddexp(0, -z) + (trials - successes) * -np.logaddexp(0, z)
        return -float(likelihood.sum())

    middle = values[np.argmin(np.abs(successes / trials - 0.5))]
    best = minimize(loss, [middle, np.log(0.02)], method="Nelder-Mead", options={"maxiter": 2000}).x
    return Transition(float(best[0]), float(least + np.exp(best[1])))


def fit_onset(
    values: Float[np.ndarray, " values"], energies: Float[np.ndarray, "values tissues"]
) -> Transition | None:
    r"""Where rigid tissues would lose their energy: $\sqrt{E} \propto p^* - p^0$, extrapolated.

    In a rigid tissue the perimeters are limited, so its energy grows like the square of the difference from
    the target. Unlike the count of tissues at zero energy, this does not depend on the last cell that reaches
    its target.

    **Arguments:**

    - `values`: target shape factors, ascending.
    - `energies`: per cell, of tissues at each.

    **Returns:** the line through the lower half of the values that have energy: where it ends, and the
    inverse of its slope as the width; None if there are fewer than three.
    """
    roots = np.sqrt(np.maximum(energies, 0)).mean(axis=1)
    rigid = np.flatnonzero(roots > 0.1 * roots.max())
    if len(rigid) < 3:
        return None
    lower = rigid[: max(3, (len(rigid) + 1) // 2)]
    slope, offset = np.polyfit(np.asarray(values)[lower], roots[lower], 1)
    return Transition(float(-offset / slope), float(-1 / slope))
