"""Indexing without checks of bounds."""

from jaxtyping import Array, Int, Shaped


def take(array: Shaped[Array, "n *shape"], index: Int[Array, "..."]) -> Shaped[Array, "..."]:
    """`array[index]` for valid, non-negative indices (not checked)."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
