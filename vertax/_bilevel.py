"""The inverse problem: parameters whose equilibrium minimises a cost."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree
from tqdm.auto import tqdm

from vertax._equilibrium import Equilibrium, equilibrate
from vertax._tissue import Tissue
from vertax._transitions import T1, AbstractTransitions
from vertax.adjoints import AbstractAdjoint
from vertax.costs import AbstractCost
from vertax.energies import AbstractEnergy

Energy = TypeVar("Energy", bound=AbstractEnergy)


class InverseProblem(eqx.Module, Generic[Energy]):
    r"""Find the parameters whose equilibrium minimises a cost (paper, "Bilevel optimization").

    $$\min_\theta C(X^*_\theta, \theta) \quad \text{subject to} \quad
      X^*_\theta \in \arg\min_X E(X, \theta)$$

    **Arguments:**

    - `tissue`: where the first relaxation starts.
    - `energy`: the energy, with the first guess of its parameters.
    - `cost`: what to minimise.
    - `trainable`: which leaves of the energy are fitted: a predicate of a leaf, or a pytree of booleans
        shaped like the energy (as in `equinox.partition`). By default every floating-point array;
        Python floats are constants.
    - `fit_position`: fit also where the whole tissue lies. No parameter of an energy moves the centroid
        of a tissue, so a cost that sees positions (an image) needs this unless they are known.
    - `adjoint`, `solver`, `transitions`, `tolerance`, `patience`, `max_steps`: passed on to
        [`equilibrate`][vertax.equilibrate].
    """

    tissue: Tissue
    energy: Energy
    cost: AbstractCost
    trainable: PyTree[bool] | Callable[[Any], bool] = eqx.is_inexact_array
    fit_position: bool = False
    adjoint: AbstractAdjoint | None = None
    solver: optx.AbstractMinimiser | None = None
    transitions: AbstractTransitions | None = T1()
    tolerance: float | Float[Array, ""] | None = None
    patience: int = 1
    max_steps: int = 2000

    def __call__(
        self,
        energy: AbstractEnergy | None = None,
        tissue: Tissue | None = None,
        shift: Float[Array, 2] | None = None,
    ) -> tuple[Float[Array, ""], Equilibrium]:
        """Cost and equilibrium for some parameters.

        **Arguments:**

        - `energy`: the energy, by default the problem's.
        - `tissue`: where the relaxation starts, by default the problem's tissue.
        - `shift`: a displacement of the relaxed tissue as a whole, by default none.

        **Returns:** the cost, differentiable in `energy` and `shift`, and the equilibrium.
        """
        energy = self.energy if energy is None else energy
        equilibrium = equilibrate(
            self.tissue if tissue is None else tissue,
            energy,
            solver=self.solver,
            adjoint=self.adjoint,
            transitions=self.transitions,
            tolerance=self.tolerance,
            patience=self.patience,
            max_steps=self.max_steps,
            throw=False,
        )
        if shift is not None:
            placed = equilibrium.tissue.with_vertices(equilibrium.tissue.vertices + shift)
            equilibrium = eqx.tree_at(lambda e: e.tissue, equilibrium, placed)
        return self.cost(equilibrium.tissue, energy), equilibrium


class History(eqx.Module):
    """What happened in each epoch of a fit."""

    cost: Float[np.ndarray, " epochs"]
    """Cost at the parameters that the epoch began with."""
    max_force: Float[np.ndarray, " epochs"]
    """Largest force of the equilibrium."""
    converged: Bool[np.ndarray, " epochs"]
    """Whether the relaxation reached equilibrium."""
    num_steps: Int[np.ndarray, " epochs"]
    """Steps of the relaxation."""
    num_t1: Int[np.ndarray, " epochs"]
    """T1 transitions of the relaxation."""
    gradient_norm: Float[np.ndarray, " epochs"]
    """Norm of the hypergradient."""
    relative_error: Float[np.ndarray, " epochs"]
    """Mean of |inferred - true| / |true| over all parameters; NaN if the truth is not known."""
    seconds: Float[np.ndarray, " epochs"]
    """Wall-clock time of each epoch; the first one includes compilation."""

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
    cost: Float[Array, ""]
    """Its cost."""
    max_force: Float[Array, ""]
    """Largest force at this equilibrium."""
    best_epoch: int
    """The epoch that they come from."""
    history: History
    """One entry an epoch."""


class FitError(RuntimeError):
    """A fit that could not go on; `fit` holds what there was until then, if anything."""

    def __init__(self, message: str, fit: Fit | None):
        super().__init__(message)
        self.fit = fit


class _State(eqx.Module):
    parameters: PyTree[Array]
    optimiser: PyTree
    tissue: Tissue


class _Record(eqx.Module):
    parameters: PyTree[Array]  # at which the cost was evaluated
    tissue: Tissue
    cost: Float[Array, ""]
    max_force: Float[Array, ""]
    converged: Bool[Array, ""]
    num_steps: Int[Array, ""]
    num_t1: Int[Array, ""]
    gradient_norm: Float[Array, ""]
    relative_error: Float[Array, ""]


def fit(
    problem: InverseProblem[Energy],
    optimiser: optax.GradientTransformation,
    epochs: int,
    *,
    truth: AbstractEnergy | None = None,
    progress: bool = True,
    callback: Callable[[int, _Record], None] | None = None,
) -> Fit[Energy]:
    """Solve an inverse problem with an Optax optimiser.

    Each epoch relaxes the tissue from the last equilibrium, takes the gradient of the cost through it
    and lets the optimiser, whose state lives through all epochs, update the parameters.

    **Arguments:**

    - `problem`: the inverse problem.
    - `optimiser`: e.g. `optax.adam(1e-2)`, or `optax.nadam(1e-3)` as in the paper.
    - `epochs`: number of updates.
    - `truth`: the energy with the true parameters where they are known, to record the error.
    - `progress`: show a progress bar (only on a terminal).
    - `callback`: called with the number and the record of each epoch.

    **Returns:** a [`Fit`][vertax.Fit] with the parameters of lowest cost among the epochs that reached
    equilibrium. An interrupt from the keyboard ends the fit early and keeps what it has.

    **Raises:**

    - `ValueError` if there is nothing to fit, or for less than one epoch.
    - [`FitError`][vertax.FitError] if cost or gradient are not finite, if the linear solve behind
        the gradient fails, or if no epoch reached equilibrium; it carries the fit so far.
    """
    if epochs < 1:
        raise ValueError(f"Argument `epochs` must be at least 1, but is {epochs}.")
    parameters, constants = eqx.partition(problem.energy, problem.trainable)
    if not jax.tree.leaves(parameters):
        raise ValueError(
            "There is nothing to fit: no leaf of the energy is selected by `trainable`. Parameters are "
            "arrays, as in LineTension(jnp.full(n_edges, 1.0)); Python floats are constants."
        )
    # Weakly typed arrays (jnp.full(20, 3.7)) turn into strong ones at the first update, and each change
    # of type would compile the epoch anew.
    parameters = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), parameters)
    true = None if truth is None else eqx.filter(truth, problem.trainable)
    fitted = cast(optax.Params, (parameters, _no_shift(problem)))
    state = _State(parameters, optimiser.init(fitted), problem.tissue)
    best: tuple[int, _Record] | None = None
    rows: list[dict[str, float]] = []
    stopped = None
    bar = tqdm(range(epochs), unit="epoch", disable=None if progress else True)
    try:
        for epoch in bar:
            began = time.perf_counter()
            state, record = _epoch(problem, optimiser, constants, true, state)
            cost, slope = float(record.cost), float(record.gradient_norm)
            row = {
                "cost": cost,
                "max_force": float(record.max_force),
                "converged": bool(record.converged),
                "num_steps": int(record.num_steps),
                "num_t1": int(record.num_t1),
                "gradient_norm": slope,
                "relative_error": float(record.relative_error),
                "seconds": time.perf_counter() - began,
            }
            rows.append(row)
            if not (np.isfinite(cost) and np.isfinite(slope)):
                stopped = f"cost ({cost}) or gradient ({slope}) is not finite in epoch {epoch}"
                break
            if record.converged and (best is None or cost < float(best[1].cost)):
                best = epoch, record
            bar.set_postfix(cost=f"{cost:.3e}", force=f"{row['max_force']:.1e}", t1=row["num_t1"])
            if callback is not None:
                callback(epoch, record)
    except KeyboardInterrupt:
        if best is None:
            raise
    except eqx.EquinoxRuntimeError as error:
        stopped = f"epoch {len(rows)} broke down ({_first_line(error)})"
    if not rows:
        raise FitError(f"The fit stopped: {stopped}.", None)
    history = History(**{name: np.asarray([row[name] for row in rows]) for name in rows[0]})
    if best is None:
        raise FitError(
            "No epoch of the fit reached equilibrium: raise `max_steps`, loosen `tolerance`, or use the "
            f"default solver (largest force: {history.max_force.min():.1e}). Stopped because "
            f"{stopped or 'all epochs were done'}.",
            None,
        )
    epoch, record = best
    outcome = Fit(
        eqx.combine(record.parameters, constants),
        record.tissue,
        record.cost,
        record.max_force,
        epoch,
        history,
    )
    if stopped is not None:
        raise FitError(f"The fit stopped: {stopped}. Try a smaller step of the optimiser.", outcome)
    return outcome


def _no_shift(problem: InverseProblem) -> Float[Array, "2"] | None:
    """Where a fitted position starts in each epoch; None if it is not fitted."""
    # It is counted from the last equilibrium: an update displaces the tissue, and is forgotten.
    return jnp.zeros(2, problem.tissue.vertices.dtype) if problem.fit_position else None


def _first_line(error: Exception) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)


@eqx.filter_jit
def _epoch(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    constants: PyTree,
    true: PyTree[Array] | None,
    state: _State,
) -> tuple[_State, _Record]:
    """One relaxation, gradient and update."""

    def cost(fitted: tuple[PyTree[Array], Array | None]) -> tuple[Array, Equilibrium]:
        parameters, shift = fitted
        return problem(eqx.combine(parameters, constants), state.tissue, shift)

    fitted = (state.parameters, _no_shift(problem))
    (value, equilibrium), gradient = jax.value_and_grad(cost, has_aux=True)(fitted)
    updates, optimiser_state = optax.with_extra_args_support(optimiser).update(
        gradient, state.optimiser, cast(optax.Params, fitted), value=value, grad=gradient
    )
    parameters, shift = eqx.apply_updates(fitted, updates)
    following = equilibrium.tissue
    if shift is not None:
        following = following.with_vertices(following.vertices + shift)
    record = _Record(
        parameters=state.parameters,
        tissue=equilibrium.tissue,
        cost=value,
        max_force=equilibrium.max_force,
        converged=equilibrium.converged,
        num_steps=equilibrium.num_steps,
        num_t1=equilibrium.num_t1,
        gradient_norm=optax.tree.norm(gradient),
        relative_error=_relative_error(state.parameters, true),
    )
    # A relaxation that broke down must not be where the next one starts.
    finite = jnp.all(jnp.isfinite(equilibrium.tissue.vertices))
    warm = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old),
        *(eqx.filter(t, eqx.is_array) for t in (following, state.tissue)),
    )
    tissue = eqx.combine(warm, following)
    return _State(parameters, optimiser_state, tissue), record


def _relative_error(parameters: PyTree[Array], true: PyTree[Array] | None) -> Float[Array, ""]:
    if true is None:
        return jnp.array(jnp.nan)
    errors = jax.tree.map(lambda p, q: jnp.ravel(jnp.abs(p - q) / jnp.abs(q)), parameters, true)
    return jnp.mean(jnp.concatenate(jax.tree.leaves(errors)))
