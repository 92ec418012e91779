"""Sums and products of points, row by row: of a tissue a row is a vertex, or an arc."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree
from optax import tree

from vertax._base.sums import total
from vertax.solvers._solver import Rows


def inner(a: PyTree, b: PyTree) -> Float[Array, ""]:
    """The inner product of two points."""
    return jnp.asarray(tree.sum(jax.tree.map(jnp.multiply, a, b)))


def row_inner(a: Float[Array, "rows ..."], b: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    """The inner product of each row with the other one's."""
    columns = (x.reshape(len(x), -1).T for x in (a, b))
    return total(x * y for x, y in zip(*columns, strict=True))


def sizes(x: Float[Array, "rows ..."]) -> Float[Array, " rows"]:
    """The length of each row."""
    return jnp.sqrt(row_inner(x, x))


def times(rows: Float[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    """Each row so many times."""
    return rows.reshape(rows.shape + (1,) * (x.ndim - rows.ndim)) * x


def typical_size(x: PyTree[Float[Array, "..."]]) -> Float[Array, ""]:
    """The length that rows have which are not zero: few long ones count less than they do in the mean."""
    roots = jax.tree.map(lambda x: jnp.sqrt(sizes(x)), x)
    some = jnp.asarray(tree.sum(jax.tree.map(jnp.count_nonzero, roots)))
    return (jnp.asarray(tree.sum(roots)) / jnp.maximum(some, 1)) ** 2


def number_of(rows: Rows) -> int:
    """How many rows there are in all."""
    return sum(r.shape[0] for r in jax.tree.leaves(rows))
