"""Who descends from whom."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax.mesh import Tissue

HERE, DIVIDED, DIED = 0, 1, 2


class Lineage(eqx.Module):
    """All cells that there ever were, by a number of their own, in the order of their birth.

    A cell that divides ends, and two begin. There is room for so many; `complete` says whether it was enough.
    """

    mother: Int[Array, "*batch records"]
    """The number of the mother; -1 for the first cells, and where there is no such cell yet."""
    begun: Float[Array, "*batch records"]
    """When it was born; infinity where there is none."""
    ended: Float[Array, "*batch records"]
    """When it divided or died; infinity if it did not."""
    fate: Int[Array, "*batch records"]
    """0 if it is there still, 1 if it divided, 2 if it died."""
    count: Int[Array, "*batch"]
    """How many there were."""

    @property
    def complete(self) -> Bool[Array, "*batch"]:
        """Whether there was room for all."""
        return self.count <= self.mother.shape[-1]


def founded(
    tissue: Tissue, time: Float[Array, ""], size: int
) -> tuple[Lineage, Int[Array, " cells"]]:
    """The lineage of the first cells, and the number of the one in each slot (-1: none)."""
    rank = jnp.cumsum(tissue.alive) - 1
    count = jnp.sum(tissue.alive)
    there = jnp.arange(size) < count
    never = jnp.full(size, jnp.inf, time.dtype)
    begun = jnp.where(there, time, never)
    lineage = Lineage(jnp.full(size, -1), begun, never, jnp.zeros(size, int), count)
    return lineage, jnp.where(tissue.alive, rank, -1)


def divided_at(
    lineage: Lineage,
    number: Int[Array, " cells"],
    pair: Int[Array, "2"],
    time: Float[Array, ""],
    done: Bool[Array, ""],
) -> tuple[Lineage, Int[Array, " cells"]]:
    """The lineage after a division, if there was one: of a slot into two."""
    size, slots = lineage.mother.shape[0], number.shape[0]
    mother = number[pair[0]]
    born = lineage.count + jnp.arange(2)
    where = jnp.where(done, born, size)
    ends = jnp.where(done & (mother >= 0), mother, size)
    put = lambda array, at, value: array.at[at].set(value, mode="drop")
    lineage = Lineage(
        put(lineage.mother, where, mother),
        put(lineage.begun, where, time),
        put(lineage.ended, ends, time),
        put(lineage.fate, ends, DIVIDED),
        lineage.count + 2 * done,
    )
    return lineage, put(number, jnp.where(done, pair, slots), born)


def died_at(
    lineage: Lineage,
    number: Int[Array, " cells"],
    gone: Bool[Array, " cells"],
    time: Float[Array, ""],
) -> tuple[Lineage, Int[Array, " cells"]]:
    """The lineage after some cells went."""
    at = jnp.where(gone & (number >= 0), number, lineage.mother.shape[0])
    ended = lineage.ended.at[at].set(time, mode="drop")
    fate = lineage.fate.at[at].set(DIED, mode="drop")
    lineage = eqx.tree_at(lambda x: (x.ended, x.fate), lineage, (ended, fate))
    return lineage, jnp.where(gone, -1, number)
