"""Solving an inverse problem: the loop over epochs, and what it records."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Generic, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree
from tqdm import tqdm

from vertax._equilibrium import Equilibrium
from vertax._inverse import Energy, InverseProblem
from vertax._tissue import Tissue
from vertax.adjoints import GradientOutcome, ImplicitDifferentiation
from vertax.energies import AbstractEnergy


class History(eqx.Module):
    """What happened in each epoch of a fit; in a batch there is a second axis for its members."""

    cost: Float[np.ndarray, "epochs *batch"]
    """Cost at the parameters that the epoch began with."""
    max_force: Float[np.ndarray, "epochs *batch"]
    """Largest force of the equilibrium."""
    converged: Bool[np.ndarray, "epochs *batch"]
    """Whether the relaxation reached equilibrium."""
    num_steps: Int[np.ndarray, "epochs *batch"]
    """Steps of the relaxation."""
    num_t1: Int[np.ndarray, "epochs *batch"]
    """T1 transitions of the relaxation."""
    gradient_norm: Float[np.ndarray, "epochs *batch"]
    """Norm of the hypergradient."""
    gradient_residual: Float[np.ndarray, "epochs *batch"]
    """How far the adjoint came, see [`GradientOutcome`][vertax.GradientOutcome]; NaN if not known."""
    gradient_steps: Float[np.ndarray, "epochs *batch"]
    """Steps of the adjoint; NaN if not known."""
    relative_error: Float[np.ndarray, "epochs *batch"]
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
    cost: Float[Array, "*batch"]
    """Its cost; infinite for a member of a batch that never reached equilibrium."""
    max_force: Float[Array, "*batch"]
    """Largest force at this equilibrium."""
    best_epoch: Int[np.ndarray, "*batch"]
    """The epoch that they come from; -1 for a member of a batch that never reached equilibrium."""
    history: History
    """One entry an epoch."""


class FitError(RuntimeError):
    """A fit that could not go on; `fit` holds what there was until then, if anything."""

    def __init__(self, message: str, fit: Fit | None):
        super().__init__(message)
        self.fit = fit


class Record(eqx.Module):
    """One epoch of a fit, as its callback sees it."""

    parameters: PyTree[Array]
    """The fitted leaves of the energy, at which the cost was evaluated."""
    tissue: Tissue
    """Their equilibrium."""
    cost: Float[Array, "*batch"]
    max_force: Float[Array, "*batch"]
    converged: Bool[Array, "*batch"]
    num_steps: Int[Array, "*batch"]
    num_t1: Int[Array, "*batch"]
    gradient_norm: Float[Array, "*batch"]
    outcome: GradientOutcome
    relative_error: Float[Array, "*batch"]
    sound: Bool[Array, "*batch"]
    """Whether cost and gradient are finite and can be trusted."""


class _Best(eqx.Module):
    parameters: PyTree[Array]
    tissue: Tissue
    cost: Float[Array, ""]
    max_force: Float[Array, ""]
    guidance: Float[Array, ""]
    epoch: Int[Array, ""]


class _State(eqx.Module):
    parameters: PyTree[Array]
    optimiser: PyTree
    tissue: Tissue
    best: _Best
    going: Bool[Array, ""]  # False once an epoch was not sound


def fit(
    problem: InverseProblem[Energy],
    optimiser: optax.GradientTransformation | optx.AbstractLeastSquaresSolver[Any, Any, Any, Any],
    epochs: int,
    *,
    truth: AbstractEnergy | None = None,
    guidance: Callable[[Int[Array, ""]], ArrayLike] | None = None,
    batched: bool = False,
    progress: bool = True,
    callback: Callable[[int, Record], None] | None = None,
) -> Fit[Energy]:
    r"""Solve an inverse problem.

    Each epoch relaxes the tissue from the last equilibrium, takes the gradient of the cost through it
    and lets the optimiser, whose state lives through all epochs, update the parameters.

    With a least-squares solver, such as `optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)`, each
    epoch takes the Jacobian of all residuals, and all epochs run as one compiled loop, which ends when
    the solver does. Where the data determine the parameters it needs a dozen epochs. The cost must be
    an [`AbstractLeastSquaresCost`][vertax.costs.AbstractLeastSquaresCost] or a weighted sum of such.

    If the tissue has to change its topology on the way, its own gradient need not lead there: it sees
    one valley of a rugged landscape (paper, "Topological cost functions unlock robust parameter
    inference"). `guidance` then lets the cost itself pull the tissue, which relaxes $E + \kappa C$, and
    fits the parameters so that there is less and less to pull. With strong guidance the tissue is
    where the cost wants it, and the fit balances forces there; as $\kappa \to 0$ it becomes the inverse
    problem itself. At parameters that explain the target exactly it makes no difference.

    **Arguments:**

    - `problem`: the inverse problem.
    - `optimiser`: an Optax optimiser, e.g. `optax.adam(1e-2)`, or `optax.nadam(1e-3)` as in the paper;
        or a least-squares solver of Optimistix.
    - `epochs`: number of updates.
    - `truth`: the energy with the true parameters where they are known, to record the error.
    - `guidance`: strength $\kappa$ of the guidance by epoch, such as an Optax schedule, in place of that
        of the problem; it should end at 0. Vertices feel a mean cost one by one: about 10 times the
        number of cells is strong. Of an Optax optimiser only.
    - `batched`: `problem` (and `truth`) are a batch of independent problems, as made by
        `equinox.filter_vmap` or by stacking: every array has a leading axis. They are solved as one
        `vmap`, and everything in the result has that axis too. A member that breaks down stays where it
        was, and the others go on.
    - `progress`: show a progress bar (only on a terminal).
    - `callback`: called with the number and the record of each epoch of an Optax optimiser.

    **Returns:** a [`Fit`][vertax.Fit] with the parameters of lowest cost among the epochs that reached
    equilibrium, and among those of the weakest guidance if there is any. An interrupt from the keyboard
    ends the fit early and keeps what it has.

    **Raises:**

    - `ValueError` if there is nothing to fit, for less than one epoch, for a batch whose arrays
        differ in their leading axis, or for `guidance` of a least-squares solver.
    - `TypeError` for a least-squares solver with a cost that is no sum of squares.
    - [`FitError`][vertax.FitError] if cost or gradient are not finite or cannot be trusted, or if no
        epoch reached equilibrium; it carries the fit so far.
    """
    if epochs < 1:
        raise ValueError(f"Argument `epochs` must be at least 1, but is {epochs}.")
    parameters, constants = eqx.partition(problem.energy, problem.trainable)
    if not jax.tree.leaves(parameters):
        raise ValueError(
            "There is nothing to fit: no leaf of the energy is selected by `trainable`. Parameters are "
            "arrays, as in LineTension(jnp.full(n_edges, 1.0)); Python floats are constants."
        )
    if batched:
        _check_batch((problem, truth))
    if guidance is not None and isinstance(optimiser, optx.AbstractLeastSquaresSolver):
        raise ValueError(
            "Argument `guidance` goes with an Optax optimiser: a least-squares solver has no epochs of "
            "its own. Set the guidance of the problem, or leave it out."
        )
    # Weakly typed arrays (jnp.full(20, 3.7)) turn into strong ones at the first update, and each change
    # of type would compile the epoch anew.
    parameters = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), parameters)
    true = None if truth is None else eqx.filter(truth, problem.trainable)
    task = (problem, parameters, constants, true, epochs, batched)
    if isinstance(optimiser, optx.AbstractLeastSquaresSolver):
        best, rows, stopped = _solve(optimiser, *task)
    else:
        best, rows, stopped = _descend(optimiser, *task, guidance, progress, callback)
    if not rows:
        raise FitError(f"The fit stopped: {stopped}.", None)
    history = History(**{name: np.asarray([row[name] for row in rows]) for name in rows[0]})
    if not np.isfinite(best.cost).any():
        raise FitError(
            "No epoch of the fit reached equilibrium: raise `max_steps`, loosen `tolerance`, or use the "
            f"default solver (largest force: {history.max_force.min():.1e}). Stopped because "
            f"{stopped or 'all epochs were done'}.",
            None,
        )
    outcome = Fit(
        eqx.combine(best.parameters, constants),
        best.tissue,
        best.cost,
        best.max_force,
        np.asarray(best.epoch),
        history,
    )
    if stopped is not None:
        raise FitError(f"The fit stopped: {stopped}. Try a smaller step of the optimiser.", outcome)
    return outcome


def _check_batch(tree: PyTree) -> None:
    arrays = [x for x in jax.tree.leaves(tree) if eqx.is_array(x)]
    sizes = {x.shape[0] if x.ndim else None for x in arrays}
    if len(sizes) != 1 or None in sizes:
        raise ValueError(
            "Argument `problem` (and `truth`) must be a batch if `batched` is set: all arrays need one "
            "leading axis of one size, but there are "
            f"{sorted('none' if s is None else str(s) for s in sizes)}. Make it with "
            "equinox.filter_vmap, or stack problems with jax.tree.map."
        )


def _descend(
    optimiser: optax.GradientTransformation,
    problem: InverseProblem,
    parameters: PyTree[Array],
    constants: PyTree,
    true: PyTree[Array] | None,
    epochs: int,
    batched: bool,
    guidance: Callable[[Int[Array, ""]], ArrayLike] | None,
    progress: bool,
    callback: Callable[[int, Record], None] | None,
) -> tuple[_Best, list[dict[str, Any]], str | None]:
    """Epochs of an Optax optimiser: the best point, what happened, and why it stopped early."""
    # A step that cannot be trusted is refused here, one member of a batch at a time.
    throw = problem.adjoint.throw
    problem = eqx.tree_at(lambda p: p.adjoint.throw, problem, False)
    state = _start(problem, optimiser, parameters, batched)
    rows: list[dict[str, Any]] = []
    bar = tqdm(range(epochs), unit="epoch", disable=None if progress else True)
    try:
        for epoch in bar:
            began = time.perf_counter()
            number = jnp.array(epoch)
            strength = None if guidance is None else _strength(guidance(number), problem)
            state, record = _epoch(
                problem, optimiser, constants, true, state, number, strength, throw, batched
            )
            sound = np.asarray(record.sound)  # waits for the epoch to be done
            rows.append(_row(record, time.perf_counter() - began))
            if not sound.any():
                return state.best, rows, _trouble(record, epoch)
            row = rows[-1]
            bar.set_postfix(
                cost=f"{np.nanmean(row['cost']):.3e}",
                force=f"{np.max(row['max_force']):.1e}",
                t1=int(np.sum(row["num_t1"])),
            )
            if callback is not None:
                callback(epoch, record)
    except KeyboardInterrupt:
        if not np.isfinite(state.best.cost).any():
            raise
    except eqx.EquinoxRuntimeError as error:
        return state.best, rows, f"epoch {len(rows)} broke down ({_first_line(error)})"
    return state.best, rows, None


def _strength(value: ArrayLike, problem: InverseProblem) -> Float[Array, ""]:
    strength = jnp.asarray(value, problem.tissue.vertices.dtype)
    if strength.shape or not strength >= 0:
        raise ValueError(
            f"Argument `guidance` must give one number that is not negative, but gave {value}."
        )
    return strength


def _row(record: Record, seconds: float) -> dict[str, Any]:
    names = [field.name for field in dataclasses.fields(History)]
    known = {name: getattr(record, name) for name in names if hasattr(record, name)}
    known["gradient_residual"] = record.outcome.residual
    known["gradient_steps"] = record.outcome.num_steps
    return {name: np.asarray(value) for name, value in known.items()} | {"seconds": seconds}


def _trouble(record: Record, epoch: int) -> str:
    cost, slope = np.asarray(record.cost), np.asarray(record.gradient_norm)
    if np.isfinite(cost).all() and np.isfinite(slope).all():
        residual = np.max(record.outcome.residual)
        return (
            f"the gradient of epoch {epoch} cannot be trusted (residual {residual:.1e}; an adjoint with "
            "throw=False goes on all the same)"
        )
    return f"cost ({cost}) or gradient ({slope}) is not finite in epoch {epoch}"


def _first_line(error: Exception) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _no_shift(problem: InverseProblem) -> Float[Array, "2"] | None:
    """Where a fitted position starts in each epoch; None if it is not fitted."""
    # It is counted from the last equilibrium: an update displaces the tissue, and is forgotten.
    return jnp.zeros(2, problem.tissue.vertices.dtype) if problem.fit_position else None


def _unbeaten(problem: InverseProblem, parameters: PyTree[Array]) -> _Best:
    infinite = jnp.asarray(jnp.inf, problem.tissue.vertices.dtype)
    return _Best(parameters, problem.tissue, infinite, infinite, infinite, jnp.array(-1))


def _better(
    best: _Best,
    parameters: PyTree,
    tissue: Tissue,
    cost: Array,
    force: Array,
    guidance: Array,
    epoch: Array,
    ok: Array,
) -> _Best:
    new = _Best(parameters, tissue, cost, force, guidance, epoch)
    # Guidance makes any cost small: only costs at the same one can be compared.
    lower = (guidance < best.guidance) | ((guidance == best.guidance) & (cost < best.cost))
    return _choose(ok & lower, new, best)


def _guidance_of(problem: InverseProblem) -> Float[Array, ""]:
    return jnp.asarray(
        0 if problem.guidance is None else problem.guidance, problem.tissue.vertices.dtype
    )


def _choose(condition: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    pick = lambda a, b: jnp.where(condition, a, b) if eqx.is_array(a) else a
    return jax.tree.map(pick, new, old)


@eqx.filter_jit
def _start(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    parameters: PyTree[Array],
    batched: bool,
) -> _State:
    def start(problem: InverseProblem, parameters: PyTree[Array]) -> _State:
        fitted = cast(optax.Params, (parameters, _no_shift(problem)))
        best = _unbeaten(problem, parameters)
        return _State(parameters, optimiser.init(fitted), problem.tissue, best, jnp.array(True))

    return (eqx.filter_vmap(start) if batched else start)(problem, parameters)


@eqx.filter_jit
def _epoch(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    constants: PyTree,
    true: PyTree[Array] | None,
    state: _State,
    epoch: Int[Array, ""],
    guidance: Float[Array, ""] | None,
    throw: bool,
    batched: bool,
) -> tuple[_State, Record]:
    """One relaxation, gradient and update, for each of the batch."""

    def one(
        problem: InverseProblem, constants: PyTree, true: PyTree[Array] | None, state: _State
    ) -> tuple[_State, Record]:
        if guidance is not None:
            problem = dataclasses.replace(problem, guidance=guidance)
        shift = _no_shift(problem)
        value, equilibrium, gradient, outcome = problem.value_and_gradient(
            eqx.combine(state.parameters, constants), state.tissue, shift
        )
        record = _record(state.parameters, value, equilibrium, gradient, outcome, true, throw)
        going = state.going & record.sound
        fitted = (state.parameters, shift)
        updates, optimiser_state = optax.with_extra_args_support(optimiser).update(
            cast(optax.Updates, gradient),
            state.optimiser,
            cast(optax.Params, fitted),
            value=value,
            grad=gradient,
        )
        parameters, shift = eqx.apply_updates(fitted, updates)
        following = equilibrium.tissue
        if shift is not None:
            following = following.with_vertices(following.vertices + shift)
        best = _better(
            state.best,
            state.parameters,
            equilibrium.tissue,
            value,
            equilibrium.max_force,
            _guidance_of(problem),
            epoch,
            going & equilibrium.converged,
        )
        moved = _State(parameters, optimiser_state, following, best, going)
        # A relaxation that broke down must not be where the next one starts.
        return _choose(going, moved, eqx.tree_at(lambda s: s.going, state, going)), record

    arguments = (problem, constants, true, state)
    return (eqx.filter_vmap(one) if batched else one)(*arguments)


def _record(
    parameters: PyTree[Array],
    value: Array,
    equilibrium: Equilibrium,
    gradient: PyTree[Array],
    outcome: GradientOutcome,
    true: PyTree[Array] | None,
    throw: bool,
) -> Record:
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(value) & jnp.isfinite(norm)
    return Record(
        parameters=parameters,
        tissue=equilibrium.tissue,
        cost=value,
        max_force=equilibrium.max_force,
        converged=equilibrium.converged,
        num_steps=equilibrium.num_steps,
        num_t1=equilibrium.num_t1,
        gradient_norm=norm,
        outcome=outcome,
        relative_error=_relative_error(parameters, true),
        sound=finite & outcome.trusted if throw else finite,
    )


def _relative_error(parameters: PyTree[Array], true: PyTree[Array] | None) -> Float[Array, ""]:
    if true is None:
        return jnp.full_like(jax.tree.leaves(parameters)[0].ravel()[0], jnp.nan)
    errors = jax.tree.map(lambda p, q: jnp.ravel(jnp.abs(p - q) / jnp.abs(q)), parameters, true)
    return jnp.mean(jnp.concatenate(jax.tree.leaves(errors)))


def _solve(
    solver: optx.AbstractLeastSquaresSolver,
    problem: InverseProblem,
    parameters: PyTree[Array],
    constants: PyTree,
    true: PyTree[Array] | None,
    epochs: int,
    batched: bool,
) -> tuple[_Best, list[dict[str, Any]], str | None]:
    """Epochs of a least-squares solver."""
    began = time.perf_counter()
    best, n_done, record = jax.block_until_ready(
        _least_squares(solver, problem, parameters, constants, true, epochs, batched)
    )
    last = np.asarray(n_done) - 1
    seconds = (time.perf_counter() - began) / (np.max(last) + 1)

    def at(x: Array, epoch: int) -> np.ndarray:
        # A member of a batch that was done earlier stands still in the epochs of the others.
        own = np.minimum(epoch, last)
        return np.take_along_axis(np.asarray(x), own[..., None], -1)[..., 0]

    unknown = np.full_like(np.asarray(last, float), np.nan)
    unknowns = dict.fromkeys(("gradient_norm", "gradient_residual", "gradient_steps"), unknown)
    rows = []
    for epoch in range(int(np.max(last)) + 1):
        facts = {name: at(x, epoch) for name, x in record.items()}
        rows.append(facts | unknowns | {"seconds": seconds})
    return best, rows, None


# Steps in a row that a solver may refuse before it counts as done.
_PATIENCE = 8


@eqx.filter_jit
def _least_squares(
    solver: optx.AbstractLeastSquaresSolver,
    problem: InverseProblem,
    parameters: PyTree[Array],
    constants: PyTree,
    true: PyTree[Array] | None,
    epochs: int,
    batched: bool,
) -> tuple[_Best, Int[Array, "*batch"], dict[str, Array]]:
    """The best point, the number of steps, and what happened in each of them."""

    def one(
        problem: InverseProblem, constants: PyTree, true: PyTree, parameters: PyTree
    ) -> tuple[_Best, Array, dict[str, Array]]:
        def evaluate(y: PyTree, tissue: Tissue) -> tuple[Array, tuple]:
            parameters, shift = y
            residuals, relaxed, placed = problem.residuals(
                eqx.combine(parameters, constants), tissue, shift
            )
            # A relaxation that did not arrive says nothing of these parameters: the solver must not
            # go there, and comes closer if the cost is worse than any other.
            worst = jnp.asarray(jnp.finfo(residuals.dtype).max ** 0.25, residuals.dtype)
            ok = relaxed.converged & jnp.all(jnp.isfinite(residuals))
            residuals = jnp.where(ok, scale * residuals, worst)
            facts = {
                "cost": 0.5 * jnp.sum((residuals / scale) ** 2),
                "max_force": relaxed.max_force,
                "converged": ok,
                "num_steps": relaxed.num_steps,
                "num_t1": relaxed.num_t1,
                "relative_error": _relative_error(parameters, true),
            }
            aux = eqx.filter((relaxed.tissue, placed), eqx.is_array), facts
            return residuals, aux

        # The damping that a solver begins with suits residuals of order one.
        fitted = (parameters, _no_shift(problem))
        scale = jnp.ones((), problem.tissue.vertices.dtype)
        first, _ = evaluate(fitted, problem.tissue)
        scale = jax.lax.rsqrt(jnp.maximum(jnp.sum(first**2), jnp.finfo(first.dtype).tiny))

        # Forward mode solves the systems of all parameters as one batch; other adjoints have none.
        forward = isinstance(problem.adjoint, ImplicitDifferentiation)
        options = {"jac": "fwd" if forward else "bwd"}
        tags: frozenset[object] = frozenset()
        fn = eqx.filter_closure_convert(evaluate, fitted, problem.tissue)
        f_struct, aux_struct = fn.out_struct  # pyright: ignore[reportFunctionMemberAccess]
        state = solver.init(fn, fitted, problem.tissue, options, f_struct, aux_struct, tags)
        dynamic, static = eqx.partition(state, eqx.is_array)
        empty = lambda x: jnp.zeros((epochs, *x.shape), x.dtype)
        log = jax.tree.map(empty, aux_struct[1])

        def unfinished(carry: tuple) -> Bool[Array, ""]:
            *_, step, n_still, done = carry
            return ~done & (n_still < _PATIENCE) & (step < epochs)

        def advance(carry: tuple) -> tuple:
            y, dynamic, tissue, best, log, step, n_still, _ = carry
            state = eqx.combine(dynamic, static)
            y, state, _ = solver.step(fn, y, tissue, options, state, tags)
            (arrays, facts) = state.aux  # those of the last accepted point, which is y
            tissue, placed = (eqx.combine(a, problem.tissue) for a in arrays)
            log = jax.tree.map(lambda rows, x: rows.at[step].set(x), log, facts)
            reached = (facts["cost"], facts["max_force"], _guidance_of(problem))
            best = _better(best, y[0], placed, *reached, step, facts["converged"])
            still = (step > 0) & (facts["cost"] == log["cost"][step - 1])
            done, result = solver.terminate(fn, y, tissue, options, state, tags)
            done = done | (result != optx.RESULTS.successful)
            dynamic = eqx.filter(state, eqx.is_array)
            return y, dynamic, tissue, best, log, step + 1, jnp.where(still, n_still + 1, 0), done

        best = _unbeaten(problem, parameters)
        zero = jnp.array(0)
        start = (fitted, dynamic, problem.tissue, best, log, zero, zero, jnp.array(False))
        *_, best, log, step, _, _ = jax.lax.while_loop(unfinished, advance, start)
        return best, step, log

    arguments = (problem, constants, true, parameters)
    return (eqx.filter_vmap(one) if batched else one)(*arguments)
