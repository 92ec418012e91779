"""Whether a fit came to its end, and what kept it from going further."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vertax.fitting._history import Fit

RELAXATIONS = "relaxations ended before equilibrium"
FALLING = "the cost was still falling at the last epoch"
NEVER = "no epoch reached equilibrium"


def limits(fit: Fit[Any], reached: Bool[np.ndarray, "*batch"]) -> str | list[str]:
    """What kept a fit from its goal, in words.

    **Arguments:**

    - `fit`: the fit, or a batch.
    - `reached`: whether its best parameters are good enough.

    **Returns:** "reached", or the first that holds of: relaxations ended before equilibrium; the cost was
    still falling; T1 transitions went on to the end; the gradient vanished; the cost stopped falling. A
    list for a batch.
    """
    reached = np.asarray(reached)
    if not reached.ndim:
        return _limit(bool(reached), *_curves(fit))
    return [_limit(bool(done), *_curves(fit, k)) for k, done in enumerate(reached)]


def doubts(fit: Fit[Any]) -> list[str]:
    """Why a fit may not be at its end.

    **Arguments:**

    - `fit`: the fit, or a batch.

    **Returns:** sentences without a full stop, the remedy included; none if nothing is wrong. Of a batch
    they say how many members they hold for.
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
        f"{text}{f' in {sum(who)} of {len(who)} members' if batch else ''} ({remedies[text]})"
        for text, who in holds.items()
        if any(who)
    ]


def still_falling(
    cost: Float[np.ndarray, " epochs"], converged: Bool[np.ndarray, " epochs"]
) -> bool:
    """Whether the last tenth of the epochs made more than a hundredth of the way down.

    Optimisers that take small steps go on for ever: a cost that has come down by all but a hundredth is
    done, and one that never fell has nothing to go on with.
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
    """Cost, convergence, T1 transitions and slope of a fit, or of one of a batch."""
    history = fit.history
    every = (history.cost, history.converged, history.num_t1, history.gradient_norm)
    return every if index is None else tuple(curve[:, index] for curve in every)  # pyright: ignore


def _last(epochs: int) -> slice:
    return slice(-max(epochs // 5, 1), None)


def _unrelaxed(converged: Bool[np.ndarray, " epochs"]) -> bool:
    return bool(converged[_last(len(converged))].mean() < 0.9)


def _limit(
    reached: bool,
    cost: Float[np.ndarray, " epochs"],
    converged: Bool[np.ndarray, " epochs"],
    num_t1: Int[np.ndarray, " epochs"],
    slope: Float[np.ndarray, " epochs"],
) -> str:
    last = _last(len(cost))
    if reached:
        return "reached"
    if _unrelaxed(converged):
        return RELAXATIONS
    if still_falling(cost, converged):
        return FALLING
    if num_t1[last].any():
        return "T1 transitions to the end, which the gradient does not foresee"
    if np.median(slope[last]) < 1e-3 * slope.max():
        return "gradient vanished: a minimum, or parameters at their bounds"
    return "stopped falling"
