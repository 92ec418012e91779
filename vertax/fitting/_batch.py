"""Batches: many of a kind as one pytree with a leading axis, and one of them again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vertax.fitting._history import Fit, History

Tree = TypeVar("Tree", bound=Any)


def stack(trees: Sequence[Tree]) -> Tree:
    """A batch of pytrees of one structure: each array gets a leading axis.

    ```python
    problems = [make(key) for key in jax.random.split(jax.random.key(0), 8)]
    fits = vx.fit(vx.fitting.stack(problems), optax.adam(1e-2), 200, batched=True)
    first = vx.fitting.member(fits.energy, 0)
    ```

    **Arguments:**

    - `trees`: tissues of one size, energies, inverse problems, … What is no array in them (functions,
        Python numbers) must be the same in all.

    **Returns:** the batch.

    **Raises:**

    - `ValueError` for no trees, and for those that differ in structure, in the shape of an array or in
        what is no array.
    """
    trees = list(trees)
    if not trees:
        raise ValueError("Argument `trees` must hold at least one pytree, but is empty.")
    structures = [jax.tree.structure(tree) for tree in trees]
    for number, structure in enumerate(structures):
        if structure != structures[0]:
            raise ValueError(
                "Argument `trees` must hold pytrees of one structure, such as tissues with equally many "
                f"cells and one kind of boundary, but number {number} differs from number 0."
            )
    return jax.tree.map(_stacked, *trees)


def member(tree: Tree, index: int) -> Tree:
    """One of a batch.

    **Arguments:**

    - `tree`: the batch: each of its arrays has a leading axis.
    - `index`: which, from 0.

    **Returns:** its member.

    **Raises:**

    - `IndexError` if there are not so many.
    """
    sizes = {x.shape[0] if x.ndim else 0 for x in jax.tree.leaves(tree) if _is_array(x)}
    # JAX takes the last one for an index beyond the end.
    if sizes and not -min(sizes) <= index < min(sizes):
        raise IndexError(
            f"Argument `index` must lie in 0 … {min(sizes) - 1}, the members of the batch, but is {index}."
        )
    return jax.tree.map(lambda x: x[index] if _is_array(x) else x, tree)


def stack_fits(fits: Sequence[Fit[Any]], *, at_once: int = 1) -> Fit[Any]:
    """Fits of problems of one shape, which were done one by one, as the fit of a batch.

    **Arguments:**

    - `fits`: the fits; those that took more epochs are cut to the number of the shortest.
    - `at_once`: how many of them ran side by side: the seconds of an epoch are those of all fits, over this.

    **Returns:** the [`Fit`][vertax.Fit] of the batch, notes included.

    **Raises:**

    - `ValueError` as [`stack`][vertax.fitting.stack], and for fits whose notes have different names.
    """
    energies, tissues = stack([fit.energy for fit in fits]), stack([fit.tissue for fit in fits])
    names = set(fits[0].notes)
    if any(set(fit.notes) != names for fit in fits):
        raise ValueError("Argument `fits` must hold fits whose notes have the same names.")
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
        interrupted=any(fit.interrupted for fit in fits),
    )


def _is_array(x: Any) -> bool:
    return eqx.is_array(x) or isinstance(x, np.ndarray)


def _stacked(first: Any, *others: Any) -> Any:
    if _is_array(first):
        shapes = [np.shape(x) for x in (first, *others)]
        if len(set(shapes)) > 1:
            raise ValueError(
                "Argument `trees` must hold arrays of equal shapes in the same places, but some are of "
                f"shapes {', '.join(map(str, dict.fromkeys(shapes)))}."
            )
        return jnp.stack([first, *others])
    for other in others:
        if other is not first and other != first:
            raise ValueError(
                "Argument `trees` must not differ in what is no array, but one holds "
                f"{first!r} where another holds {other!r}. Make numbers that differ arrays: jnp.array(…)."
            )
    return first
