"""The cell lineage: mother, birth and fate of each cell."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue

ALIVE, DIVIDED, DIED = 0, 1, 2


class Lineage(eqx.Module):
    """One record per cell, in the order of birth; the arrays have a fixed length.

    A division ends the record of the mother and begins two records.
    """

    mother: Int[Array, "*batch records"]
    """Index of the mother; -1 for initial cells and unused records."""
    begun: Float[Array, "*batch records"]
    """Time of birth; infinity for unused records."""
    ended: Float[Array, "*batch records"]
    """Time of division or death; infinity for living cells and unused records."""
    fate: Int[Array, "*batch records"]
    """0 for living cells and unused records, 1 if the cell divided, 2 if it died."""
    count: Int[Array, "*batch"]
    """Number of cells."""


def initial_lineage(
    tissue: Tissue, time: Float[Array, ""], size: int
) -> tuple[Lineage, Int[Array, " cells"]]:
    """The lineage of the initial cells, and the record of the cell in each slot (-1 for spare slots)."""
    rank = jnp.cumsum(tissue.alive) - 1
    count = jnp.sum(tissue.alive)
    used = jnp.arange(size) < count
    never = jnp.full(size, jnp.inf, time.dtype)
    begun = jnp.where(used, time, never)
    lineage = Lineage(jnp.full(size, -1), begun, never, jnp.zeros(size, int), count)
    return lineage, jnp.where(tissue.alive, rank, -1)


def record_division(
    lineage: Lineage,
    number: Int[Array, " cells"],
    pair: Int[Array, "2"],
    time: Float[Array, ""],
    done: Bool[Array, ""],
) -> tuple[Lineage, Int[Array, " cells"]]:
    """Record the division of the cell in slot `pair[0]` into the slots `pair`, if `done`."""
    size, slots = lineage.mother.shape[0], number.shape[0]
    mother = number[pair[0]]
    born = lineage.count + jnp.arange(2)
    birth_index = jnp.where(done, born, size)
    mother_index = jnp.where(done & (mother >= 0), mother, size)
    put = lambda array, index, value: array.at[index].set(value, mode="drop")
    lineage = Lineage(
        put(lineage.mother, birth_index, mother),
        put(lineage.begun, birth_index, time),
        put(lineage.ended, mother_index, time),
        put(lineage.fate, mother_index, DIVIDED),
        lineage.count + 2 * done,
    )
    return lineage, put(number, jnp.where(done, pair, slots), born)


def record_deaths(
    lineage: Lineage,
    number: Int[Array, " cells"],
    died: Bool[Array, " cells"],
    time: Float[Array, ""],
) -> tuple[Lineage, Int[Array, " cells"]]:
    """Record the deaths of the cells in the slots `died`."""
    index = jnp.where(died & (number >= 0), number, lineage.mother.shape[0])
    ended = lineage.ended.at[index].set(time, mode="drop")
    fate = lineage.fate.at[index].set(DIED, mode="drop")
    lineage = eqx.tree_at(lambda x: (x.ended, x.fate), lineage, (ended, fate))
    return lineage, jnp.where(died, -1, number)
