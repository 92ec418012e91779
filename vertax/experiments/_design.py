"""What experiments of inverse design have in common: their sections, their fits and what limits them."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from pydantic import Field, model_validator
from tqdm import tqdm

from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation, ImplicitDifferentiation
from vertax.energies import AbstractEnergy, AreaElasticity, BoundedTension, LocalSum
from vertax.experiments._scenes import stack
from vertax.fitting import Fit, History, InverseProblem, Record
from vertax.mesh import Tissue
from vertax.runs._config import Section
from vertax.runs._folder import RunFolder
from vertax.runs._sections import Fitting


class Gradient(Section):
    """How gradients through the equilibrium are taken."""

    method: Literal["implicit", "propagation"] = "implicit"
    """Implicit differentiation, or equilibrium propagation."""
    nudge: Literal["linear", "cost"] = "linear"
    """The nudge of equilibrium propagation; cost lets T1 transitions follow the cost."""
    beta: float | None = Field(default=None, gt=0)
    """Its strength; left out, it is chosen by the precision."""
    nudged_rtol: float | None = Field(default=None, gt=0)
    """Tolerance of nudged relaxations relative to the nudge; left out, chosen by the precision."""

    def build(self) -> AbstractAdjoint:
        """The adjoint.

        **Returns:** one that goes on where a gradient did not converge: the history has its residual.
        """
        if self.method == "implicit":
            return ImplicitDifferentiation(throw=False)
        return EquilibriumPropagation(self.beta, self.nudge, rtol=self.nudged_rtol, throw=False)


class Tensions(Section):
    """Line tensions of the edges and stiffness of the cells, where the mean rest area of a cell is 1."""

    low: float = Field(default=0.04, ge=0)
    """Least tension."""
    high: float = Field(default=0.28, gt=0)
    """Largest tension; above twice the least one, there are junctions of three edges without a balance,
    which close to four-fold vertices."""
    stiffness: float = Field(default=1.0, gt=0)
    """Stiffness of the areas of cells."""

    @model_validator(mode="after")
    def _ordered(self) -> Tensions:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, but they are {self.low} and {self.high}")
        return self

    def draw(self, tissue: Tissue, spread: float, key: PRNGKeyArray) -> LocalSum:
        """The energy E2 with a tension for each edge.

        **Arguments:**

        - `tissue`: the tissue.
        - `spread`: the share of the range, about its middle, that tensions are drawn from; below 1.
        - `key`: of the draw.

        **Returns:** the energy; the tensions are [`BoundedTension`][vertax.energies.BoundedTension].
        """
        unit = jax.random.uniform(key, (tissue.n_edges,), minval=-1.0, maxval=1.0)
        share = 0.5 + 0.5 * spread * unit
        tension = BoundedTension(self.low + (self.high - self.low) * share, self.low, self.high)
        return LocalSum((AreaElasticity(self.stiffness, 1.0), tension))


def tensions(energy: AbstractEnergy) -> Float[np.ndarray, "*batch edges"]:
    """The tensions of an energy of `Tensions.draw`.

    **Arguments:**

    - `energy`: the energy, or a batch.

    **Returns:** tension of each edge.
    """
    return np.asarray(terms_of(energy)[1].tension, float)


def terms_of(energy: AbstractEnergy) -> tuple[AreaElasticity, BoundedTension]:
    """The two parts of an energy E2 whose tensions have bounds.

    **Arguments:**

    - `energy`: the energy, or a batch.

    **Returns:** the areas' part, and that of the tensions.
    """
    assert isinstance(energy, LocalSum)
    area, tension = energy.terms
    assert isinstance(area, AreaElasticity)
    assert isinstance(tension, BoundedTension)
    return area, tension


Measure = Callable[[InverseProblem, Tissue, PyTree], PyTree[Array]]


def design(
    folder: RunFolder,
    name: str,
    problem: InverseProblem,
    fitting: Fitting,
    measure: Measure,
    *,
    progress: bool,
) -> tuple[Fit, Tissue, PyTree[np.ndarray]]:
    """Fit, and measure something in each epoch.

    **Arguments:**

    - `folder`, `name`: see `RunFolder.fit`.
    - `problem`: the inverse problem.
    - `fitting`: how it is fitted.
    - `measure`: a function of the problem, its tissue in equilibrium and the fitted leaves of the energy;
        the same function compiles once.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** the fit; the equilibrium that it began with; and what was measured, each array with a
    leading axis of epochs.

    **Raises:**

    - `FitError` if the fit cannot go on.
    """
    parameters = eqx.filter(problem.energy, problem.trainable)
    example = eqx.filter_eval_shape(_measured, measure, problem, problem.tissue, parameters)
    leaves, structure = jax.tree.flatten(problem.tissue)

    def note(epoch: int, record: Record) -> dict[str, Any]:
        if folder.interrupted:  # Ctrl-C reaches one thread only
            raise KeyboardInterrupt
        if epoch == 0:
            start = jax.tree.leaves(record.tissue)
            folder.part(f"{name} start", lambda: _by_number(start))
        found = _measured(measure, problem, record.tissue, record.parameters)
        return _by_number(jax.tree.leaves(found))

    outcome = folder.fit(
        name, problem, fitting.build(), fitting.epochs, progress=progress, callback=note
    )
    start = folder.part(f"{name} start", dict)
    first = jax.tree.unflatten(structure, [jnp.asarray(start[str(i)]) for i in range(len(leaves))])
    measured = [outcome.notes[str(i)] for i in range(len(outcome.notes))]
    return outcome, first, jax.tree.unflatten(jax.tree.structure(example), measured)


@eqx.filter_jit
def _measured(
    measure: Measure, problem: InverseProblem, tissue: Tissue, parameters: PyTree
) -> PyTree[Array]:
    return measure(problem, tissue, parameters)


def designs(
    folder: RunFolder,
    name: str,
    problems: Sequence[InverseProblem],
    fitting: Fitting,
    measure: Measure,
    *,
    progress: bool,
) -> tuple[Fit, Tissue, PyTree[np.ndarray]]:
    """Fit problems of one shape side by side, one thread a core.

    As a batch they would all wait, in each epoch, for the one that takes the most steps to relax; with
    T1 transitions that is many times as many as the others take.

    **Arguments:**

    - `folder`, `name`, `problems`, `fitting`, `measure`: see `design`.
    - `progress`: show a progress bar (only on a terminal).

    **Returns:** what `design` returns, as of a batch; seconds are those of all members, over the number
    of threads.

    **Raises:**

    - `FitError` if a fit cannot go on.
    """
    threads = os.cpu_count() or 1

    def one(k: int) -> tuple[Fit, Tissue, PyTree[np.ndarray]]:
        return design(folder, f"{name} {k}", problems[k], fitting, measure, progress=False)

    with tqdm(total=len(problems), unit="fit", disable=None if progress else True) as bar:
        found = [one(0)]  # the first one compiles
        bar.update()
        # What is compiled runs outside of Python's lock.
        with concurrent.futures.ThreadPoolExecutor(threads) as pool:
            try:
                for each in pool.map(one, range(1, len(problems))):
                    found.append(each)
                    bar.update()
            except KeyboardInterrupt:
                folder.interrupted = True
                raise
    outcomes, firsts, curves = zip(*found, strict=True)
    epochs = min(len(outcome.history.cost) for outcome in outcomes)
    columns = {
        field.name: [getattr(outcome.history, field.name)[:epochs] for outcome in outcomes]
        for field in dataclasses.fields(History)
    }
    seconds, guidance = (np.stack(columns.pop(key)) for key in ("seconds", "guidance"))
    stacked = {key: np.stack(column, axis=1) for key, column in columns.items()}
    batch = Fit(
        energy=stack([outcome.energy for outcome in outcomes]),
        tissue=stack([outcome.tissue for outcome in outcomes]),
        cost=jnp.stack([outcome.cost for outcome in outcomes]),
        max_force=jnp.stack([outcome.max_force for outcome in outcomes]),
        best_epoch=np.stack([outcome.best_epoch for outcome in outcomes]),
        history=History(**stacked, seconds=seconds.sum(axis=0) / threads, guidance=guidance[0]),
        notes={},
        interrupted=any(outcome.interrupted for outcome in outcomes),
    )
    measured = jax.tree.map(lambda *x: np.stack([y[:epochs] for y in x], axis=1), *curves)
    return batch, stack(firsts), measured


def _by_number(leaves: Sequence[Array]) -> dict[str, np.ndarray]:
    return {str(i): np.asarray(leaf) for i, leaf in enumerate(leaves)}


def member(tree: PyTree, index: int) -> Any:
    """One of a batch.

    **Arguments:**

    - `tree`: the batch.
    - `index`: which.

    **Returns:** its member.
    """
    is_array = lambda x: eqx.is_array(x) or isinstance(x, np.ndarray)
    return jax.tree.map(lambda x: x[index] if is_array(x) else x, tree)


def limits(outcome: Fit, reached: np.ndarray) -> str | list[str]:
    """What kept a fit from its goal, in words.

    **Arguments:**

    - `outcome`: the fit, or a batch.
    - `reached`: whether its best design is good enough.

    **Returns:** "reached", or the first that holds of: relaxations ended early; the cost was still
    falling; T1 transitions went on to the end; the gradient vanished; the cost stopped falling. A list
    for a batch.
    """
    history = outcome.history
    curves = (history.converged, history.num_t1, history.gradient_norm)
    if not reached.ndim:
        return _limit(bool(reached), int(outcome.best_epoch), *curves)
    return [
        _limit(bool(done), int(best), *(curve[:, k] for curve in curves))
        for k, (done, best) in enumerate(zip(reached, outcome.best_epoch, strict=True))
    ]


def _limit(
    reached: bool, best_epoch: int, converged: np.ndarray, num_t1: np.ndarray, slope: np.ndarray
) -> str:
    if reached:
        return "reached"
    epochs = len(converged)
    last = slice(-max(epochs // 5, 1), None)
    if converged[last].mean() < 0.9:
        return "relaxations ended before equilibrium"
    if best_epoch >= 0.95 * (epochs - 1):
        return "still falling at the last epoch"
    if num_t1[last].any():
        return "T1 transitions to the end, which the gradient does not foresee"
    if np.median(slope[last]) < 1e-3 * slope.max():
        return "gradient vanished: a minimum, or tensions at their bounds"
    return "stopped falling"


def mean_and_deviation(values: Any) -> dict[str, float]:
    """Mean and standard deviation.

    **Arguments:**

    - `values`: numbers.

    **Returns:** both by name.
    """
    values = np.asarray(values, float)
    return {"mean": float(values.mean()), "deviation": float(values.std())}


def keys_of(seed: int, n: int) -> list[PRNGKeyArray]:
    """Random keys of replicates: those of the first do not depend on how many there are.

    **Arguments:**

    - `seed`: the seed of the run.
    - `n`: number of replicates.

    **Returns:** the keys.
    """
    return [jax.random.fold_in(jax.random.key(seed), k) for k in range(n)]
