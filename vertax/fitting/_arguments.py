"""Checks of the arguments of a fit."""

from __future__ import annotations

from typing import Any

import optax
import optimistix as optx

from vertax._base.checks import check_function, check_instance, check_integer, describe
from vertax.fitting._inverse import InverseProblem


def check_arguments(
    problem: Any, optimiser: Any, epochs: Any, guidance: Any, callback: Any
) -> None:
    """Raise an error with a remedy for invalid arguments of [`fit`][vertax.fit].

    **Raises:**

    - `TypeError` for an argument of a wrong type.
    - `ValueError` for less than one epoch.
    """
    check_instance("problem", problem, InverseProblem, "a vertax.InverseProblem")
    _check_optimiser(optimiser)
    check_integer("epochs", epochs, at_least=1)
    if guidance is not None:
        expected = "a function of the epoch, such as optax.linear_schedule(1.0, 0.0, 100)"
        remedy = "A constant strength is set in the problem: InverseProblem(..., guidance=...)."
        check_function("guidance", guidance, expected, remedy)
    if callback is not None:
        check_function("callback", callback, "a function of epoch and record")


def _check_optimiser(optimiser: Any) -> None:
    if isinstance(
        optimiser,
        optax.GradientTransformation | optax.MultiSteps | optx.AbstractLeastSquaresSolver,
    ):
        return
    remedy = (
        "Pass an Optax optimiser, such as optax.adam(1e-2), or a least-squares solver, such as "
        "optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)."
    )
    if isinstance(optimiser, str) and callable(getattr(optax, optimiser, None)):
        remedy = f"Write optax.{optimiser}(learning_rate)."
    elif isinstance(optimiser, optx.AbstractMinimiser):
        remedy = (
            "Minimisers relax tissues: they are for the `solver` of a relaxation. For the parameters "
            f"p{remedy[1:]}"
        )
    elif callable(optimiser):
        remedy = f"Call it: {getattr(optimiser, '__name__', 'optimiser')}(…)."
    raise TypeError(
        "Argument `optimiser` must be an optimiser of parameters, but is "
        f"{describe(optimiser)}. {remedy}"
    )
