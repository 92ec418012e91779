"""Stack single fits to the fit of a batch, and take them from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import jax.numpy as jnp
import numpy as np

from vertax._base import batch
from vertax._base.batch import stack
from vertax.fitting._history import Fit, History

Tree = TypeVar("Tree")


def member(tree: Tree, index: int) -> Tree:
    """Take one member of a batch.

    **Arguments:**

    - `tree`: the batch: each of its arrays has a leading axis. A [`Fit`][vertax.Fit] has the members on the
        second axis of its history, and of notes if that axis has their number.
    - `index`: the index of the member, from 0.

    **Returns:** its member.

    **Raises:**

    - `IndexError` for an index out of range.
    """
    if not isinstance(tree, Fit):
        return batch.member(tree, index)
    parts = {
        field.name: batch.member(getattr(tree, field.name), index)
        for field in dataclasses.fields(Fit)
        if field.name not in ("history", "notes")
    }
    of_member = lambda x: x[:, index] if x.shape[1:2] == tree.cost.shape else x
    columns = {name: of_member(np.asarray(x)) for name, x in vars(tree.history).items()}
    notes = {name: of_member(x) for name, x in tree.notes.items()}
    return cast(Tree, Fit(**parts, history=History(**columns), notes=notes))


def stack_fits(fits: Sequence[Fit[Any]], *, at_once: int = 1) -> Fit[Any]:
    """Stack single fits of problems of one shape to the fit of a batch.

    **Arguments:**

    - `fits`: the fits; longer histories are truncated to the number of epochs of the shortest.
    - `at_once`: number of fits that ran in parallel: the seconds of an epoch are the sum over all fits,
        divided by this number.

    **Returns:** the [`Fit`][vertax.Fit] of the batch, notes included.

    **Raises:**

    - `ValueError` as [`stack`][vertax.fitting.stack], and for notes of different names.
    """
    energies, tissues = stack([fit.energy for fit in fits]), stack([fit.tissue for fit in fits])
    names = set(fits[0].notes)
    if any(set(fit.notes) != names for fit in fits):
        raise ValueError("Argument `fits` must hold fits with notes of the same names.")
    epochs = min(len(fit.history.cost) for fit in fits)
    columns = {
        field.name: np.stack([getattr(fit.history, field.name)[:epochs] for fit in fits], axis=1)
        for field in dataclasses.fields(History)
    }
    columns["seconds"] = columns["seconds"].sum(axis=1) / at_once
    columns["guidance"] = columns["guidance"][:, 0]
    return Fit(
        energy=energies,
        tissue=tissues,
        cost=jnp.stack([fit.cost for fit in fits]),
        max_force=jnp.stack([fit.max_force for fit in fits]),
        best_epoch=np.stack([fit.best_epoch for fit in fits]),
        history=History(**columns),
        notes={n: np.stack([fit.notes[n][:epochs] for fit in fits], axis=1) for n in names},
        result=stack([fit.result for fit in fits]),
    )
