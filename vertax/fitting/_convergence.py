"""Convergence of a fit: the reason why it stopped, and warnings with remedies."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.fitting._history import Fit

RELAXATIONS = "relaxations ended before equilibrium"
FALLING = "the cost was still falling at the last epoch"
NEVER = "no epoch reached equilibrium"


def limits(fit: Fit[Any], reached: Bool[np.ndarray, "*batch"]) -> str | list[str]:
    """What limited a fit, as a text.

    **Arguments:**

    - `fit`: the fit, or a batch.
    - `reached`: whether its best parameters are good enough.

    **Returns:** "reached" or the first condition that applies, in the last fifth of the epochs; a list for a
    batch:

    1. relaxations ended before equilibrium (10 % or more of them);
    2. the cost was still falling;
    3. T1 transitions happened;
    4. the gradient vanished (median norm below 1e-3 of the maximum over all epochs);
    5. the cost stopped falling.
    """
    reached = np.asarray(reached)
    if not reached.ndim:
        return _limit(bool(reached), *_curves(fit))
    return [_limit(bool(enough), *_curves(fit, k)) for k, enough in enumerate(reached)]


def fit_warnings(fit: Fit[Any]) -> list[str]:
    """Warnings about the convergence of a fit, with remedies.

    **Arguments:**

    - `fit`: the fit, or a batch.

    **Returns:** sentences without a full stop; an empty list if the fit converged. For a batch each sentence
    states the number of members that it applies to.
    """
    batch = np.shape(fit.best_epoch)
    members = [_curves(fit, k) for k in range(batch[0])] if batch else [_curves(fit)]
    best = np.atleast_1d(fit.best_epoch)
    remedies = {
        NEVER: "raise max_steps, or loosen the tolerance",
        RELAXATIONS: "raise max_steps, or loosen the tolerance",
        FALLING: "raise the number of epochs",
    }
    holds = {
        NEVER: [epoch < 0 for epoch in best],
        RELAXATIONS: [
            epoch >= 0 and _unrelaxed(converged)
            for epoch, (_, converged, *_) in zip(best, members, strict=True)
        ],
        FALLING: [still_falling(cost, converged) for cost, converged, *_ in members],
    }
    return [
        f"{text}{f' in {sum(flags)} of {len(flags)} members' if batch else ''} ({remedies[text]})"
        for text, flags in holds.items()
        if any(flags)
    ]


def still_falling(
    cost: Float[np.ndarray, " epochs"], converged: Bool[np.ndarray, " epochs"]
) -> bool:
    """Whether more than 1 % of the total decrease of the cost happened in the last tenth of the epochs.

    Only converged epochs with a finite cost count. False for a cost that never decreased.
    """
    lowest = np.minimum.accumulate(np.where(converged & np.isfinite(cost), cost, np.inf))
    lowest = lowest[np.isfinite(lowest)]
    if len(lowest) < 2:
        return False
    before = lowest[-1 - max(len(lowest) // 10, 1)]
    return bool(before - lowest[-1] > 0.01 * (lowest[0] - lowest[-1]))


Curves = tuple[
    Float[np.ndarray, " epochs"],
    Bool[np.ndarray, " epochs"],
    Int[np.ndarray, " epochs"],
    Float[np.ndarray, " epochs"],
]


def _curves(fit: Fit[Any], index: int | None = None) -> Curves:
    """Cost, convergence, T1 transitions and gradient norm of a fit, or of a member of a batch."""
    history = fit.history
    every = (history.cost, history.converged, history.num_t1, history.gradient_norm)
    return every if index is None else tuple(curve[:, index] for curve in every)  # pyright: ignore


def _last(epochs: int) -> slice:
    """The last fifth of the epochs."""
    return slice(-max(epochs // 5, 1), None)


def _unrelaxed(converged: Bool[np.ndarray, " epochs"]) -> bool:
    """Whether 10 % or more of the last relaxations did not converge."""
    return bool(converged[_last(len(converged))].mean() < 0.9)


def _limit(
    reached: bool,
    cost: Float[np.ndarray, " epochs"],
    converged: Bool[np.ndarray, " epochs"],
    num_t1: Int[np.ndarray, " epochs"],
    gradient_norm: Float[np.ndarray, " epochs"],
) -> str:
    last = _last(len(cost))
    if reached:
        return "reached"
    if _unrelaxed(converged):
        return RELAXATIONS
    if still_falling(cost, converged):
        return FALLING
    if num_t1[last].any():
        return "T1 transitions to the end, which the gradient does not include"
    if np.median(gradient_norm[last]) < 1e-3 * gradient_norm.max():
        return "gradient vanished: a minimum, or parameters at their bounds"
    return "stopped falling"
