"""Results of a fit: the best parameters, the history, and the record of each epoch."""

from __future__ import annotations

import dataclasses
from typing import Any, Generic

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from vertax._base.results import RESULTS
from vertax.fitting._inverse import Energy
from vertax.mesh import Tissue


class Facts(eqx.Module):
    """Scalars of one epoch, or of many along a first axis; in a batch the last axis holds the members."""

    cost: Float[Any, "*axes"]
    """Cost at the initial parameters of the epoch; with a least-squares solver, at those of its last accepted
    step."""
    max_force: Float[Any, "*axes"]
    """Largest force of the equilibrium."""
    converged: Bool[Any, "*axes"]
    """Whether the relaxation reached equilibrium."""
    num_steps: Int[Any, "*axes"]
    """Steps of the relaxation."""
    num_t1: Int[Any, "*axes"]
    """T1 transitions of the relaxation."""
    gradient_norm: Float[Any, "*axes"]
    """Norm of the hypergradient; NaN for a least-squares solver."""
    gradient_residual: Float[Any, "*axes"]
    """Residual of the adjoint, see [`GradientOutcome`][vertax.GradientOutcome]; NaN if not available."""
    gradient_steps: Float[Any, "*axes"]
    """Steps of the adjoint; NaN if not available."""
    relative_error: Float[Any, "*axes"]
    """Mean of |inferred - true| / |true| over all parameters; NaN without `truth`."""

    def facts(self) -> dict[str, Any]:
        """These scalars by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(Facts)}


class History(Facts):
    """The scalars of each epoch of a fit; in a batch the second axis holds the members."""

    seconds: Float[np.ndarray, " epochs"]
    """Wall-clock time of each epoch; the first epoch of a new or resumed fit includes compilation."""
    guidance: Float[np.ndarray, " epochs"]
    """Strength from the argument `guidance` of the fit; NaN without it."""

    def columns(self) -> dict[str, np.ndarray]:
        """All curves by name, without those that are NaN in all epochs."""
        curves = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: curve for name, curve in curves.items() if not np.isnan(curve).all()}


class Fit(eqx.Module, Generic[Energy]):
    """The result of a fit: the best parameters, their equilibrium, and the history."""

    energy: Energy
    """The energy with the parameters of lowest cost."""
    tissue: Tissue
    """The equilibrium of these parameters."""
    cost: Float[Array, "*batch"]
    """Its cost; infinite for a member of a batch that never reached equilibrium."""
    max_force: Float[Array, "*batch"]
    """Largest force at this equilibrium."""
    best_epoch: Int[np.ndarray, "*batch"]
    """The epoch of these parameters; -1 for a member of a batch that never reached equilibrium."""
    history: History
    """One entry per epoch."""
    notes: dict[str, Shaped[np.ndarray, "epochs ..."]] = eqx.field(default_factory=dict)
    """Values returned by the callback, by name; the first axis is that of the epochs."""
    result: RESULTS = eqx.field(default_factory=lambda: RESULTS.successful)
    """How the fit ended, for each member of a batch; `interrupted` after a keyboard interrupt. A member
    without a valid epoch has failed."""


class FitError(RuntimeError):
    """A fit that failed; `fit` holds the result up to then, or None."""

    def __init__(self, message: str, fit: Fit | None = None):
        super().__init__(message)
        self.fit = fit


class Record(Facts):
    """One epoch of a fit, an argument of the callback; in a batch the leading axis holds the members.

    ```python
    def watch(epoch: int, record: vx.Record) -> dict[str, float]:
        return {"mean": record.parameters.target_shape_factor.mean()}

    fit = vx.fit(problem, optimiser, 200, callback=watch)
    fit.notes["mean"]  # one number per epoch
    ```
    """

    parameters: Any
    """The fitted leaves of the energy at which the cost was evaluated; the others are None. With a
    least-squares solver, those of its last accepted step."""
    tissue: Tissue
    """The equilibrium of these parameters."""
    result: RESULTS
    """Whether cost and gradient are finite, and how the adjoint ended."""

    def with_nan(self) -> Record:
        """A copy with NaN for numbers that are not available."""
        facts = {name: getattr(self, name) for name in _OPTIONAL}
        new = {name: np.where(np.asarray(x) == MISSING, np.nan, x) for name, x in facts.items()}
        return dataclasses.replace(self, **new)


MISSING = -1.0
"""A number that is not available. (A NaN from a compiled function would end a fit with `jax_debug_nans`.)"""
_OPTIONAL = ("gradient_norm", "gradient_residual", "gradient_steps", "relative_error")
