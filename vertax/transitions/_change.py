"""What becomes of a tissue when a cell comes or goes."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vertax._base.axes import AXES, gather
from vertax._base.tracing import is_concrete
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue

Tree = TypeVar("Tree")


class Change(eqx.Module):
    """A tissue in which a cell came or went, and the index of the parent of each cell, edge and vertex."""

    tissue: Tissue
    cells: Int[Array, "*batch cells"]
    """For each cell the one whose parameters it has: itself, or its mother."""
    edges: Int[Array, "*batch edges"]
    """For each edge the one whose parameters it has: itself, or the one that it was a part of. A new
    interface has those of the edge at which it begins."""
    vertices: Int[Array, "*batch vertices"]
    """For each vertex the one whose parameters it has: itself, or where the edge that was cut begins."""
    done: Bool[Array, "*batch"]
    """Whether it happened. If not the tissue is as it was."""

    def inherited(self, tree: Tree, *, axis: str | None = None) -> Tree:
        """An energy, or any other pytree, in which new cells, edges and vertices have entries of old ones.

        Which arrays have one entry for each cell, edge or vertex is what the fields that hold them declare:
        by the names of the axes of their annotation, such as `Float[Array, "cells"]` or
        `Float[Array, "knots edges"]`; or by metadata, `eqx.field(metadata={"axis": "cells"})`, with None for
        no such axis. All other arrays stay as they are, whatever their size, and so do tissues.

        **Arguments:**

        - `tree`: the pytree.
        - `axis`: what arrays have one entry (or row) for that no field declares: `"cells"`, `"edges"` or
            `"vertices"`. Needed for arrays outside of modules.

        **Returns:** the same with the entries of new cells, edges and vertices.

        **Raises:**

        - `TypeError` without `axis`, for an array that is not in a field of a module, and for an array in a
            field of an energy that declares nothing and is as long as there are cells, edges or vertices.
        - `ValueError` for an array of another length than was declared, or another `axis`.
        """
        if axis is not None and axis not in AXES:
            raise ValueError(f"Argument `axis` must be one of {AXES} or None, but is {axis!r}.")
        parents = {kind: getattr(self, kind) for kind in AXES}
        sizes = {kind: parent.shape[-1] for kind, parent in parents.items()}
        return gather(tree, parents, sizes, axis=axis, opaque=(Tissue,), strict=(AbstractEnergy,))


def unchanged(tissue: Tissue) -> Change:
    """A tissue to which nothing has happened."""
    numbers = lambda n: jnp.arange(n, dtype=tissue.topology.twin.dtype)
    return Change(
        tissue,
        numbers(tissue.n_cells),
        numbers(tissue.n_edges),
        numbers(tissue.n_vertices),
        jnp.array(False),
    )


def raise_if(change: Change, wrong: Bool[Array, ""], reason: str) -> Change:
    """The change, or an error."""
    if not is_concrete(wrong):
        return eqx.error_if(change, wrong, reason)
    if np.any(np.asarray(wrong)):
        raise RuntimeError(reason)
    return change
