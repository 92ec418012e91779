"""Batches: stack pytrees along a leading axis, and take one member."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

Tree = TypeVar("Tree", bound=Any)


def stack(trees: Sequence[Tree]) -> Tree:
    """Stack pytrees of the same structure: each array gets a leading axis.

    ```python
    problems = [make(key) for key in jax.random.split(jax.random.key(0), 8)]
    fits = vx.fit(vx.fitting.stack(problems), optax.adam(1e-2), 200, batched=True)
    first = vx.fitting.member(fits.energy, 0)
    ```

    **Arguments:**

    - `trees`: tissues of one size, energies, inverse problems, … Leaves that are not
        arrays (functions, Python numbers) must be equal in all.

    **Returns:** the batch.

    **Raises:**

    - `ValueError` without trees, and for trees that differ in structure, in the shape of an array or in
        a leaf that is not an array.
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
    """Take one member of a batch, in which each array has a leading axis; see `vertax.fitting.member`."""
    sizes = {x.shape[0] if x.ndim else 0 for x in jax.tree.leaves(tree) if _is_array(x)}
    # JAX clamps an index out of range.
    if sizes and not -min(sizes) <= index < min(sizes):
        raise IndexError(
            f"Argument `index` must lie in 0 … {min(sizes) - 1}, the members of the batch, but is {index}."
        )
    return jax.tree.map(lambda x: x[index, ...] if _is_array(x) else x, tree)


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
                "Argument `trees` must have equal leaves except for arrays, but one holds "
                f"{first!r} where another holds {other!r}. Make numbers that differ arrays: jnp.array(…)."
            )
    return first
