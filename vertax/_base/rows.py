"""Points of a minimisation as a table: one row for each vertex, and one for each arc."""

from __future__ import annotations

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from vertax._base.reductions import max_of
from vertax._base.sums import total

Rows: TypeAlias = PyTree[Float[Array, "..."]]
"""One number for each row of the arrays of a point: of a tissue one a vertex, and one an arc."""
Table: TypeAlias = Float[Array, "rows columns"]


def table_of(y: PyTree[Float[Array, "..."]]) -> Table:
    """The rows of all arrays, one below the other, with zeros in columns that an array does not have."""
    leaves = [x.reshape(x.shape[0], -1) if x.ndim else x.reshape(1, 1) for x in jax.tree.leaves(y)]
    width = max(x.shape[1] for x in leaves)
    padded = [jnp.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in leaves]
    return padded[0] if len(padded) == 1 else jnp.concatenate(padded)


def point_of(table: Table, like: PyTree[Float[Array, "..."]]) -> PyTree[Float[Array, "..."]]:
    """The arrays that `table_of` made a table of."""
    leaves, structure = jax.tree.flatten(like)
    start, parts = 0, []
    for x in leaves:
        rows = x.shape[0] if x.ndim else 1
        columns = x.size // max(rows, 1)
        parts.append(table[start : start + rows, :columns].reshape(x.shape))
        start += rows
    return jax.tree.unflatten(structure, parts)


def rows_of(rows: Float[Array, " rows"], like: PyTree[Float[Array, "..."]]) -> Rows:
    """The numbers of the rows of a table, as they belong to the arrays."""
    ones = jax.tree.map(lambda x: jnp.zeros(x.shape[:1], x.dtype), like)
    return point_of(rows[:, None], ones)


def inner(a: Table, b: Table) -> Float[Array, ""]:
    """The inner product of two points."""
    return jnp.dot(a.reshape(-1), b.reshape(-1), precision=jax.lax.Precision.HIGHEST)


def row_inner(a: Float[Array, "rows ..."], b: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    """The inner product of each row with the other one's."""
    columns = (x.reshape(len(x), -1).T for x in (a, b))
    return total(x * y for x, y in zip(*columns, strict=True))


def sizes(x: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    """The length of each row."""
    return jnp.sqrt(row_inner(x, x))


def times(rows: Float[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    """Each row times a number."""
    return rows.reshape(rows.shape + (1,) * (x.ndim - rows.ndim)) * x


def typical_size(x: Table) -> Float[Array, ""]:
    """The squared mean root length of the rows that are not zero: outliers count less than in the mean."""
    roots = jnp.sqrt(sizes(x))
    ones = jnp.ones_like(roots)
    number = jnp.dot((roots > 0).astype(roots.dtype), ones)
    return (jnp.dot(roots, ones) / jnp.maximum(number, 1)) ** 2


def max_size(x: Table) -> Float[Array, ""]:
    """The largest component, as a size; NaN if any is NaN."""
    finite = jnp.isfinite(inner(x, x))
    return jnp.where(finite, max_of(jnp.abs(x)), jnp.nan)


def rounding_error(value: Float[Array, ""], unit: Float[Array, ""] | float) -> Float[Array, ""]:
    """The rounding error of an energy, in a material with this unit of energy.

    A sum of squares may be far less than the unit: what is squared is a difference of lengths, then, and has
    their rounding.
    """
    size = jnp.abs(value)
    return 20 * jnp.finfo(value.dtype).eps * jnp.maximum(size, jnp.sqrt(size * unit))
