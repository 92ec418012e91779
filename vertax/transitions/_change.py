"""What becomes of a tissue when a cell comes or goes."""

from __future__ import annotations

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vertax._base.modules import is_concrete
from vertax.mesh import Tissue
from vertax.mesh._topology import take

Tree = TypeVar("Tree")


class Change(eqx.Module):
    """A tissue in which a cell came or went, and who takes after whom."""

    tissue: Tissue
    cells: Int[Array, "*batch cells"]
    """For each cell the one whose parameters it has: itself, or its mother."""
    edges: Int[Array, "*batch edges"]
    """For each edge the one whose parameters it has: itself, or the one that it was a part of. A new
    interface takes after the edge at which it begins."""
    done: Bool[Array, "*batch"]
    """Whether it happened. If not the tissue is as it was."""

    def inherited(self, tree: Tree) -> Tree:
        """An energy, or any other pytree, of which new cells and edges have the entries of old ones.

        **Arguments:**

        - `tree`: its arrays with one entry (or row) a cell, or one an edge, are reordered; what has another
            length stays.

        **Returns:** the same with the entries of new cells and edges.
        """
        n_cells, n_edges = self.cells.shape[-1], self.edges.shape[-1]

        def of(x: Any) -> Any:
            if not eqx.is_array(x) or x.ndim == 0 or x.shape[0] not in (n_cells, n_edges):
                return x
            return take(x, self.cells if x.shape[0] == n_cells else self.edges)

        return jax.tree.map(of, tree)


def unchanged(tissue: Tissue) -> Change:
    """A tissue to which nothing has happened."""
    numbers = lambda n: jnp.arange(n, dtype=tissue.topology.twin.dtype)
    return Change(tissue, numbers(tissue.n_cells), numbers(tissue.n_edges), jnp.array(False))


def raised_if(change: Change, wrong: Bool[Array, ""], reason: str) -> Change:
    """The change, or an error."""
    if not is_concrete(wrong):
        return eqx.error_if(change, wrong, reason)
    if np.any(np.asarray(wrong)):
        raise RuntimeError(reason)
    return change
