"""Fit of an inverse problem: the loop over epochs, with history and checkpoints."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, ArrayLike, Int, PyTree
from tqdm import tqdm

from vertax._base.announce import announce_compilations
from vertax._base.checkpoints import (
    COMPUTATION,
    Checkpoint,
    CheckpointFile,
    Progress,
    Row,
    columns_of,
    digest,
    layout,
)
from vertax._base.fingerprint import fingerprint
from vertax._base.results import RESULTS, index_of, result_of, where_is
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.fitting._arguments import check_arguments
from vertax.fitting._descent import Descent
from vertax.fitting._epoch import AbstractMethod, first_line
from vertax.fitting._history import Fit, FitError, History, Record
from vertax.fitting._inverse import Energy, InverseProblem
from vertax.fitting._least_squares import LeastSquares

Callback = Callable[[int, Record], Mapping[str, ArrayLike] | None]


@announce_compilations("a fit")
def fit(
    problem: InverseProblem[Energy],
    optimiser: optax.GradientTransformation
    | optax.MultiSteps
    | optx.AbstractLeastSquaresSolver[Any, Any, Any, Any],
    epochs: int,
    *,
    truth: AbstractEnergy | None = None,
    guidance: Callable[[Int[Array, ""]], ArrayLike] | None = None,
    batched: bool = False,
    progress: bool = True,
    callback: Callback | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
) -> Fit[Energy]:
    r"""Solve an inverse problem.

    Each epoch:

    1. relax the tissue, with the previous equilibrium as a warm start;
    2. compute the cost and its gradient through the equilibrium (the hypergradient);
    3. update the parameters by one step of the optimiser.

    With a least-squares solver, e.g. `optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)`, each epoch
    computes the Jacobian of all residuals, and the fit ends when the solver converges, typically after a
    dozen epochs if the data determine the parameters. The cost must be an
    [`AbstractLeastSquaresCost`][vertax.costs.AbstractLeastSquaresCost] or a weighted sum of such costs.

    If the fit must change the topology of the tissue, the gradient at fixed topology may not lead there
    (paper, "Topological cost functions unlock robust parameter inference"). With `guidance` $\kappa$ the
    tissue relaxes $E + \kappa C$ instead of $E$: the cost attracts the tissue to the target, through T1
    transitions too, while the fit reduces the remaining cost. For $\kappa \to 0$ this is the inverse problem
    itself. Parameters that explain the target exactly are optimal for every $\kappa$.

    **Arguments:**

    - `problem`: the inverse problem.
    - `optimiser`: an Optax optimiser, e.g. `optax.adam(1e-2)`, or `optax.nadam(1e-3)` as in the paper;
        or a least-squares solver of Optimistix. Optax receives the energy with None for its constants; with
        `fit_position` a pair of it and the displacement. Labels and masks have this structure, and must be
        functions (`lambda parameters: labels`), because energies are callable. Optimisers with a line search
        are rejected.
    - `epochs`: number of updates.
    - `truth`: the energy with the true parameters if available, to record the error.
    - `guidance`: strength $\kappa$ as a function of the epoch, e.g. an Optax schedule, which replaces that of
        the problem; it should end at 0. For a cost that is a mean over vertices, 10 times the number of cells
        is strong. For Optax optimisers only.
    - `batched`: whether `problem` (and `truth`) are a batch of independent problems, made by
        `equinox.filter_vmap` or [`stack`][vertax.fitting.stack]: every array has a leading axis, also in the
        result. A member that fails keeps its last valid state; the other members continue.
    - `progress`: show a progress bar (only on a terminal).
    - `callback`: called with the index and the [`Record`][vertax.Record] of each epoch. If it returns a
        dictionary of arrays or numbers, with the same names each time, they are in `notes` of the fit.
    - `checkpoint`: a file or a [`Checkpoint`][vertax.Checkpoint], to save the state of the fit, and to resume
        from if it exists. The callback is called only for the remaining epochs; `notes` include all epochs.

    **Returns:** a [`Fit`][vertax.Fit] with the parameters of lowest cost among the epochs that reached
    equilibrium (with guidance, among those of the weakest guidance). A keyboard interrupt (Ctrl-C) ends the
    fit after the current epoch and returns the result so far, with the `result` `interrupted`.

    **Raises:**

    - `ValueError` if there is nothing to fit, for parameters that are not finite, for less than one epoch,
        for a batch with different leading axes, for `guidance` with a least-squares solver, for a `callback`
        that returns changing names, and for a checkpoint that is broken or belongs to another fit.
    - `FileNotFoundError` if the folder of the checkpoint does not exist.
    - `TypeError` for a least-squares solver with a cost that is not a sum of squares, for an optimiser that
        needs more than parameters, gradient and cost, and for arguments of a wrong type.
    - [`FitError`][vertax.FitError] if cost or gradient are not finite, if the adjoint did not converge, or if
        no epoch reached equilibrium; it holds the fit so far.
    """
    check_arguments(problem, optimiser, epochs, guidance, callback)
    parameters, fixed = eqx.partition(problem.energy, problem.trainable)
    if not jax.tree.leaves(parameters):
        raise ValueError(
            "There is nothing to fit: no leaf of the energy is selected by `trainable`. "
            + _nothing_to_fit(problem.energy)
        )
    if batched:
        _check_batch((problem, truth))
    else:  # (In a batch the other members continue.)
        _check_finite(parameters)
    if isinstance(optimiser, optax.MultiSteps):
        optimiser = optimiser.gradient_transformation()
    dtype = problem.tissue.vertices.dtype
    parameters = traced(parameters, dtype)
    true = None if truth is None else traced(eqx.filter(truth, problem.trainable), dtype)
    given, problem = problem, _with_numbers_as_data(problem, parameters, batched)
    constants = eqx.partition(problem.energy, problem.trainable)[1]
    method: AbstractMethod
    if isinstance(optimiser, optx.AbstractLeastSquaresSolver):
        if guidance is not None:
            raise ValueError(
                "Argument `guidance` must be None for a least-squares solver, which needs the same cost in "
                "all steps. Use an Optax optimiser, or set the guidance of the problem."
            )
        # The solver accepts a step only if the cost decreases, so an inaccurate Jacobian costs one step. And
        # before the first step Optimistix computes a Jacobian of zeros, for which the adjoint would raise.
        adjoint = dataclasses.replace(problem.adjoint, throw=False)
        problem = dataclasses.replace(problem, adjoint=adjoint)
        method = LeastSquares(optimiser, problem, parameters, constants, true, batched)
    else:
        method = Descent(optimiser, problem, parameters, constants, true, batched, guidance)
    file = CheckpointFile(checkpoint, lambda: _identity_of(given, true, method, batched))
    done, stopped, result = _run(method, file, epochs, progress, callback)
    response_error = given.response.last_error_message()
    if stopped is not None and response_error is not None:
        stopped = f"{stopped}. {response_error.rstrip('.')}"
    if not done.rows:
        raise FitError(f"The fit stopped: {stopped}.", None)
    best = done.state.best
    history = History(**columns_of(done.rows))
    if not np.isfinite(best.facts.cost).any():
        overlaps = "" if batched else given.tissue.overlaps.describe()
        raise FitError(_without_best(history, stopped, overlaps), None)
    # A member without valid epochs has failed, although the fit continued. The first failure counts.
    unrelaxed = np.isfinite(history.max_force).any(axis=0)
    codes = [RESULTS.successful, result, RESULTS.nonlinear_max_steps_reached, RESULTS.nonfinite]
    successful, ended, no_equilibrium, broken = (np.asarray(index_of(code)) for code in codes)
    failure = np.where(unrelaxed, no_equilibrium, broken)
    code = np.asarray(index_of(done.state.result))
    for later in (ended, np.where(np.asarray(best.epoch) < 0, failure, successful)):
        code = np.where(code == successful, later, code)
    fit_result = Fit(
        eqx.combine(best.parameters, fixed),  # `fixed` keeps the Python numbers of the given energy
        best.tissue,
        best.facts.cost,
        best.facts.max_force,
        np.asarray(best.epoch),
        history,
        columns_of(done.notes),
        result_of(jnp.asarray(code)),
    )
    if stopped is not None:
        raise FitError(
            f"The fit stopped: {stopped}. Try a smaller step of the optimiser.", fit_result
        )
    return fit_result


def _nothing_to_fit(energy: PyTree) -> str:
    """Why the energy has no parameters, with the remedy."""
    for path, x in jax.tree_util.tree_leaves_with_path(energy):
        if isinstance(x, np.ndarray | jax.Array) and x.dtype.kind in "iu":
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            return (
                f"Parameters are arrays of floating-point numbers, but `{name}` has the type {x.dtype}. "
                f"Convert it: jnp.asarray({name}, float)."
            )
    return "Parameters are arrays, as in LineTension(jnp.full(n_edges, 1.0)); Python floats are constants."


def _check_finite(parameters: PyTree[Array]) -> None:
    for path, x in jax.tree_util.tree_leaves_with_path(parameters):
        wrong = np.argwhere(~np.isfinite(x))  # (one row for each entry, also of a number)
        if len(wrong):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(
                f"Argument `problem` must hold finite parameters, but `{name}` of its energy holds "
                f"{float(x[tuple(wrong[0])])}. Replace it."
            )


def _without_best(history: History, stopped: str | None, overlaps: str) -> str:
    """Why no epoch has a valid cost, with the remedy."""
    if history.converged.any():
        return f"The fit stopped: {stopped}."
    text = (
        "raise `max_steps`, loosen `tolerance`, or use the default solver (largest force: "
        f"{history.max_force.min():.1e})"
    )
    if not np.isfinite(history.max_force).any():
        text = (
            "the forces are not finite. Check the numbers of the energy, and whether its formula has a "
            "derivative: that of sqrt(x) is infinite at 0"
        )
    text = f"No epoch of the fit reached equilibrium: {text}. Stopped because "
    text += f"{stopped or 'all epochs were done'}."
    return text + (f" The tissue of the problem has overlaps: {overlaps}." if overlaps else "")


def _with_numbers_as_data(
    problem: InverseProblem[Energy], parameters: PyTree, batched: bool
) -> InverseProblem[Energy]:
    """The problem with arrays for its Python numbers, so that other numbers need no new compilation."""
    # Select the fitted leaves first: Python numbers of the energy are constants.
    fitted = jax.tree.map(lambda x: x is not None, parameters, is_leaf=lambda x: x is None)
    dtype = problem.tissue.vertices.dtype
    tissue, energy = traced((problem.tissue, problem.energy), dtype)
    data = dataclasses.replace(
        problem.with_array_numbers(dtype), tissue=tissue, energy=energy, trainable=fitted
    )
    if not batched:
        return data
    n = jax.tree.leaves(parameters)[0].shape[0]
    expand = lambda new, old: (
        new if eqx.is_array(old) or not eqx.is_array(new) else jnp.full(n, new)
    )
    old = dataclasses.replace(problem, trainable=fitted)
    return jax.tree.map(expand, data, old)


def _identity_of(
    problem: PyTree, truth: PyTree, method: AbstractMethod, batched: bool
) -> dict[str, str]:
    """Texts and digests that identify a fit, by their names in messages."""
    return {
        "problem (sizes, classes or settings)": layout((problem, truth)),
        "problem (numbers in its arrays)": digest((problem, truth)),
        "optimiser": method.description(),
        "setting of `batched`": str(batched),
        f"problem ({COMPUTATION})": fingerprint(lambda m: m.first_epoch(), method),
    }


def _check_batch(tree: PyTree) -> None:
    arrays = [x for x in jax.tree.leaves(tree) if eqx.is_array(x)]
    sizes = {x.shape[0] if x.ndim else None for x in arrays}
    if len(sizes) != 1 or None in sizes:
        raise ValueError(
            "Argument `problem` (and `truth`) must be a batch if `batched` is set: all arrays need a "
            "leading axis of the same size, but the sizes are "
            f"{sorted('none' if s is None else str(s) for s in sizes)}. Stack single problems with "
            "vertax.fitting.stack, or use equinox.filter_vmap."
        )


def _run(
    method: AbstractMethod,
    file: CheckpointFile,
    epochs: int,
    progress: bool,
    callback: Callback | None,
) -> tuple[Progress, str | None, RESULTS]:
    """The progress of the fit, the reason for an early end or None, and how it ended."""
    done = Progress(None)
    try:
        done = file.load(method.start())
        _check_progress(done, method, epochs)
        # The context manager closes the bar in all cases: an unclosed bar shows an outdated number of epochs.
        bar = tqdm(
            total=epochs,
            initial=len(done.rows),
            unit="epoch",
            disable=None if progress else True,
            desc="compiling",  # until the first epoch is done
        )
        with bar:
            while len(done.rows) < epochs and np.any(done.state.active):
                epoch, start = len(done.rows), time.perf_counter()
                state, record = method.advance(done.state, epoch)
                failed = ~where_is(record.result, RESULTS.successful)  # blocks until it is done
                record = record.with_nan()
                row = _row(record, time.perf_counter() - start, method.strength(epoch))
                if failed.all():
                    return (
                        Progress(state, (*done.rows, row), done.notes),
                        _failure(record, epoch),
                        result_of(jnp.max(index_of(record.result))),
                    )
                notes = None if callback is None else callback(epoch, record)
                done = Progress(state, (*done.rows, row), _noted(done.notes, notes, epoch))
                bar.set_description(refresh=False)
                bar.set_postfix(
                    cost=f"{np.nanmean(row['cost']):.3e}",
                    force=f"{np.max(row['max_force']):.1e}",
                    t1=int(np.sum(row["num_t1"])),
                )
                bar.update()
                file.save_if_due(done)
    except KeyboardInterrupt:
        if not done.rows or not np.isfinite(done.state.best.facts.cost).any():
            raise
        file.save(done)
        return done, None, RESULTS.interrupted
    except eqx.EquinoxRuntimeError as error:
        return done, f"epoch {len(done.rows)} broke down ({first_line(error)})", RESULTS.nonfinite
    file.save(done)
    return done, None, RESULTS.successful


def _check_progress(done: Progress, method: AbstractMethod, epochs: int) -> None:
    """Raise an error if a checkpoint does not match the arguments of the fit."""
    if len(done.rows) > epochs:
        raise ValueError(
            f"The checkpoint holds {len(done.rows)} epochs, but argument `epochs` is {epochs}. Raise it, "
            "choose another file as `checkpoint`, or delete the file to start this fit anew."
        )
    for epoch, row in enumerate(done.rows):
        then, now = float(row["guidance"]), method.strength(epoch)
        if not np.array_equal(then, now, equal_nan=True):
            raise ValueError(
                f"The checkpoint is that of a fit with another `guidance`: {then} and not {now} in epoch "
                f"{epoch}. Pass the same guidance, or delete the file to start this fit anew."
            )


def _noted(
    notes: tuple[Row, ...], new: Mapping[str, ArrayLike] | None, epoch: int
) -> tuple[Row, ...]:
    """The notes of all epochs so far, with those of a new epoch appended."""
    names = set() if new is None else set(new)
    if epoch > 0 and names != (set(notes[0]) if notes else set()):
        before = ", ".join(notes[0]) if notes else "nothing"
        raise ValueError(
            f"Argument `callback` must return the same names in each epoch ({before}), but returned "
            f"{', '.join(sorted(names)) or 'nothing'} in epoch {epoch}."
        )
    if new is None or not names:
        return notes
    return (*notes, {name: np.asarray(value) for name, value in new.items()})


def _row(record: Record, seconds: float, guidance: float) -> Row:
    row = {name: np.asarray(value) for name, value in record.facts().items()}
    return row | {"seconds": seconds, "guidance": guidance}


def _failure(record: Record, epoch: int) -> str:
    """Why the fit cannot continue after an epoch."""
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(record.parameters)):
        return f"a parameter of the energy is not finite in epoch {epoch}"
    cost, gradient_norm = np.asarray(record.cost), np.asarray(record.gradient_norm)
    if np.isfinite(cost).all() and np.isfinite(gradient_norm).all():
        residual = np.max(record.gradient_residual)
        message = RESULTS._index_to_message[int(np.max(index_of(record.result)))]
        reason = message.partition("cannot be trusted: ")[2].rstrip(".")
        return (
            f"the gradient of epoch {epoch} cannot be trusted (residual {residual:.1e}): {reason}"
        )
    text = f"cost ({cost}) or gradient ({gradient_norm}) is not finite in epoch {epoch}"
    if np.isfinite(cost).all() and np.asarray(record.converged).all():
        text += (
            ". The formula of the energy or the cost has no finite derivative with respect to a parameter, "
            "such as sqrt(x) at 0"
        )
    return text
