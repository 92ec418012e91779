"""Solving an inverse problem: the loop over epochs, and what it records."""

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
    Checkpoint,
    CheckpointFile,
    Progress,
    Row,
    columns_of,
    digest,
    without_addresses,
)
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.fitting._arguments import check_arguments
from vertax.fitting._descent import Descent
from vertax.fitting._epoch import AbstractMethod
from vertax.fitting._history import Fit, FitError, History, Record
from vertax.fitting._inverse import Energy, InverseProblem
from vertax.fitting._least_squares import LeastSquares

Callback = Callable[[int, Record], Mapping[str, ArrayLike] | None]


@announce_compilations("a fit")
def fit(
    problem: InverseProblem[Energy],
    optimiser: optax.GradientTransformation | optx.AbstractLeastSquaresSolver[Any, Any, Any, Any],
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

    Each epoch relaxes the tissue from the last equilibrium, takes the gradient of the cost through it
    and lets the optimiser, whose state lives through all epochs, update the parameters.

    With a least-squares solver, such as `optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)`, each
    epoch takes the Jacobian of all residuals, and the fit ends when the solver does. Where the data
    determine the parameters it needs a dozen epochs. The cost must be an
    [`AbstractLeastSquaresCost`][vertax.costs.AbstractLeastSquaresCost] or a weighted sum of such.

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
    - `callback`: called with the number and the [`Record`][vertax.Record] of each epoch. If it returns
        arrays or numbers by name, the same names each time, they are in `notes` of the fit.
    - `checkpoint`: a file, or a [`Checkpoint`][vertax.Checkpoint], to write down how far the fit has come,
        and to go on from if it is there. The callback sees only the epochs that are still to do; its notes
        are those of all.

    **Returns:** a [`Fit`][vertax.Fit] with the parameters of lowest cost among the epochs that reached
    equilibrium, and among those of the weakest guidance if there is any. An interrupt from the keyboard
    (Ctrl-C) ends the fit early, as soon as the epoch that runs is done, and keeps what came before;
    `interrupted` tells so.

    **Raises:**

    - `ValueError` if there is nothing to fit, for less than one epoch, for a batch whose arrays
        differ in their leading axis, for `guidance` of a least-squares solver, for a `callback` whose
        notes change their names, and for a checkpoint that is broken or that of another fit.
    - `FileNotFoundError` if there is no folder for the checkpoint.
    - `TypeError` for a least-squares solver with a cost that is no sum of squares, and for arguments of
        another kind, such as an optimiser that is none.
    - [`FitError`][vertax.FitError] if cost or gradient are not finite or cannot be trusted, or if no
        epoch reached equilibrium; it carries the fit so far.
    """
    check_arguments(problem, optimiser, epochs, guidance, callback)
    parameters, fixed = eqx.partition(problem.energy, problem.trainable)
    if not jax.tree.leaves(parameters):
        raise ValueError(
            "There is nothing to fit: no leaf of the energy is selected by `trainable`. Parameters are "
            "arrays, as in LineTension(jnp.full(n_edges, 1.0)); Python floats are constants."
        )
    if batched:
        _check_batch((problem, truth))
    dtype = problem.tissue.vertices.dtype
    parameters = traced(parameters, dtype)
    true = None if truth is None else traced(eqx.filter(truth, problem.trainable), dtype)
    given, problem = problem, _with_numbers_as_data(problem, parameters, batched)
    constants = eqx.partition(problem.energy, problem.trainable)[1]
    method: AbstractMethod
    if isinstance(optimiser, optx.AbstractLeastSquaresSolver):
        if guidance is not None:
            raise ValueError(
                "Argument `guidance` goes with an Optax optimiser: a least-squares solver judges its steps "
                "by one cost. Set the guidance of the problem, or leave it out."
            )
        # It judges each step by the cost itself, so a wrong slope costs a step and no more. And Optimistix
        # makes a Jacobian of zeros before the first step, of which no adjoint could be sure.
        lenient = dataclasses.replace(problem.adjoint, throw=False)
        problem = dataclasses.replace(problem, adjoint=lenient)
        method = LeastSquares(optimiser, problem, parameters, constants, true, batched)
    else:
        method = Descent(optimiser, problem, parameters, constants, true, batched, guidance)
    file = CheckpointFile(
        checkpoint, lambda: _identity_of(given, true, method.description(), batched)
    )
    done, stopped, interrupted = _run(method, file, epochs, progress, callback)
    complaint = given.response.last_error_message()
    if stopped is not None and complaint is not None:
        stopped = f"{stopped}. {complaint.rstrip('.')}"
    if not done.rows:
        raise FitError(f"The fit stopped: {stopped}.", None)
    best = done.state.best
    history = History(**columns_of(done.rows))
    if not np.isfinite(best.facts.cost).any():
        raise FitError(
            "No epoch of the fit reached equilibrium: raise `max_steps`, loosen `tolerance`, or use the "
            f"default solver (largest force: {history.max_force.min():.1e}). Stopped because "
            f"{stopped or 'all epochs were done'}.",
            None,
        )
    outcome = Fit(
        eqx.combine(best.parameters, fixed),  # its Python numbers are none that are fitted
        best.tissue,
        best.facts.cost,
        best.facts.max_force,
        np.asarray(best.epoch),
        history,
        columns_of(done.notes),
        interrupted,
    )
    if stopped is not None:
        raise FitError(f"The fit stopped: {stopped}. Try a smaller step of the optimiser.", outcome)
    return outcome


def _with_numbers_as_data(
    problem: InverseProblem[Energy], parameters: PyTree, batched: bool
) -> InverseProblem[Energy]:
    """The same problem with arrays for its Python numbers, of which another one compiles nothing anew."""
    # Which leaves are fitted is settled before: a number of the energy is a constant.
    fitted = jax.tree.map(lambda x: x is not None, parameters, is_leaf=lambda x: x is None)
    dtype = problem.tissue.vertices.dtype
    tissue, energy = traced((problem.tissue, problem.energy), dtype)
    data = dataclasses.replace(
        problem.as_data(dtype), tissue=tissue, energy=energy, trainable=fitted
    )
    if not batched:
        return data
    n = jax.tree.leaves(parameters)[0].shape[0]
    spread = lambda new, old: (
        new if eqx.is_array(old) or not eqx.is_array(new) else jnp.full(n, new)
    )
    old = dataclasses.replace(problem, trainable=fitted)
    return jax.tree.map(spread, data, old)


def _identity_of(problem: PyTree, truth: PyTree, optimiser: str, batched: bool) -> dict[str, str]:
    """What makes a fit another one than others, by what it is called in messages."""
    layout = eqx.tree_pformat((problem, truth), short_arrays=True, width=100)
    return {
        "problem (sizes, classes or settings)": without_addresses(layout),
        "problem (numbers in its arrays)": digest((problem, truth)),
        "optimiser": optimiser,
        "setting of `batched`": str(batched),
    }


def _check_batch(tree: PyTree) -> None:
    arrays = [x for x in jax.tree.leaves(tree) if eqx.is_array(x)]
    sizes = {x.shape[0] if x.ndim else None for x in arrays}
    if len(sizes) != 1 or None in sizes:
        raise ValueError(
            "Argument `problem` (and `truth`) must be a batch if `batched` is set: all arrays need one "
            "leading axis of one size, but there are "
            f"{sorted('none' if s is None else str(s) for s in sizes)}. Make it with "
            "equinox.filter_vmap, or of single problems with vertax.fitting.stack."
        )


def _run(
    method: AbstractMethod,
    file: CheckpointFile,
    epochs: int,
    progress: bool,
    callback: Callback | None,
) -> tuple[Progress, str | None, bool]:
    """How far the fit came, why it could not go on, and whether it was interrupted."""
    done = Progress(None)
    try:
        done = file.load(method.start())
        _check_progress(done, method, epochs)
        # Closed at the end, whatever ends it: a bar that is not keeps an old number of epochs.
        bar = tqdm(
            total=epochs,
            initial=len(done.rows),
            unit="epoch",
            disable=None if progress else True,
            desc="compiling",  # while the first epoch stands at 0
        )
        with bar:
            while len(done.rows) < epochs and np.any(done.state.going):
                epoch, began = len(done.rows), time.perf_counter()
                state, record = method.advance(done.state, epoch)
                sound = np.asarray(record.sound)  # waits for the epoch to be done
                row = _row(record, time.perf_counter() - began, method.strength(epoch))
                if not sound.any():
                    return (
                        Progress(state, (*done.rows, row), done.notes),
                        _trouble(record, epoch),
                        False,
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
        return done, None, True
    except eqx.EquinoxRuntimeError as error:
        return done, f"epoch {len(done.rows)} broke down ({_first_line(error)})", False
    file.save(done)
    return done, None, False


def _check_progress(done: Progress, method: AbstractMethod, epochs: int) -> None:
    """Whether a checkpoint goes with what the fit is to do."""
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
                f"{epoch}. Give the same one again, or delete the file to start this fit anew."
            )


def _noted(
    notes: tuple[Row, ...], new: Mapping[str, ArrayLike] | None, epoch: int
) -> tuple[Row, ...]:
    """The notes of all epochs, with those of another one."""
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


def _trouble(record: Record, epoch: int) -> str:
    cost, slope = np.asarray(record.cost), np.asarray(record.gradient_norm)
    if np.isfinite(cost).all() and np.isfinite(slope).all():
        residual = np.max(record.gradient_residual)
        return (
            f"the gradient of epoch {epoch} cannot be trusted (residual {residual:.1e}; an adjoint with "
            "throw=False goes on all the same)"
        )
    return f"cost ({cost}) or gradient ({slope}) is not finite in epoch {epoch}"


def _first_line(error: Exception) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
