"""What a fit hands over: its outcome, its history, and what its callback sees."""

from __future__ import annotations

import dataclasses
from typing import Any, Generic

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from vertax.fitting._inverse import Energy
from vertax.mesh import Tissue


class Facts(eqx.Module):
    """What there is to know of an epoch, or of many along a first axis.

    In a batch the last axis is that of its members.
    """

    cost: Float[Any, "*axes"]
    """Cost at the parameters that the epoch began with; with a least-squares solver, at those of its last
    accepted step."""
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
    """How far the adjoint came, see [`GradientOutcome`][vertax.GradientOutcome]; NaN if not known."""
    gradient_steps: Float[Any, "*axes"]
    """Steps of the adjoint; NaN if not known."""
    relative_error: Float[Any, "*axes"]
    """Mean of |inferred - true| / |true| over all parameters; NaN if the truth is not known."""

    def facts(self) -> dict[str, Any]:
        """These numbers by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(Facts)}


class History(Facts):
    """What happened in each epoch of a fit; in a batch there is a second axis for its members."""

    seconds: Float[np.ndarray, " epochs"]
    """Wall-clock time of each epoch; the first one, and the first of a fit that is continued, includes
    compilation."""
    guidance: Float[np.ndarray, " epochs"]
    """Strength of the guidance that the fit gave; NaN if it gave none."""

    def columns(self) -> dict[str, np.ndarray]:
        """All curves by name, without those that nothing is known of."""
        curves = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: curve for name, curve in curves.items() if not np.isnan(curve).all()}


class Fit(eqx.Module, Generic[Energy]):
    """The outcome of a fit: the best parameters, their equilibrium, and the way there."""

    energy: Energy
    """The energy with the parameters of lowest cost."""
    tissue: Tissue
    """The equilibrium of these parameters."""
    cost: Float[Array, "*batch"]
    """Its cost; infinite for a member of a batch that never reached equilibrium."""
    max_force: Float[Array, "*batch"]
    """Largest force at this equilibrium."""
    best_epoch: Int[np.ndarray, "*batch"]
    """The epoch that they come from; -1 for a member of a batch that never reached equilibrium."""
    history: History
    """One entry per epoch."""
    notes: dict[str, Shaped[np.ndarray, "epochs ..."]] = eqx.field(default_factory=dict)
    """What the callback returned, by name; the first axis is that of the epochs."""
    interrupted: bool = False
    """Whether an interrupt from the keyboard ended it before its time."""


class FitError(RuntimeError):
    """A fit that could not go on; `fit` holds what there was until then, if anything."""

    def __init__(self, message: str, fit: Fit | None):
        super().__init__(message)
        self.fit = fit


class Record(Facts):
    """One epoch of a fit, as its callback sees it; in a batch each array has a leading axis for its members.

    ```python
    def watch(epoch: int, record: vx.Record) -> dict[str, float]:
        return {"mean": record.parameters.target_shape_factor.mean()}

    fit = vx.fit(problem, optimiser, 200, callback=watch)
    fit.notes["mean"]  # one number per epoch
    ```
    """

    parameters: PyTree[Array]
    """The fitted leaves of the energy, at which the cost was evaluated; the others are None. With a
    least-squares solver, those of its last accepted step."""
    tissue: Tissue
    """Their equilibrium."""
    sound: Bool[Array, "*batch"]
    """Whether cost and gradient are finite and can be trusted."""
