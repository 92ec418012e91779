"""The result of a division or removal, and the inheritance of parameters."""

from __future__ import annotations

from typing import TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Int

from vertax._base.axes import AXES, gather
from vertax._base.checks import check_choice
from vertax._base.results import RESULTS, AbstractOutcome
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue

Tree = TypeVar("Tree")


class Change(AbstractOutcome):
    """The tissue after a division or removal, and the parent index of each cell, edge and vertex."""

    tissue: Tissue
    cells: Int[Array, "*batch cells"]
    """Index of the old cell with the parameters of each cell: itself, or its mother."""
    edges: Int[Array, "*batch edges"]
    """Index of the old edge with the parameters of each edge: itself, or the edge that was split. A new
    interface has the parameters of the edge at its start."""
    vertices: Int[Array, "*batch vertices"]
    """Index of the old vertex with the parameters of each vertex: itself, or the start of the split edge."""
    result: RESULTS
    """Why the change was not made; the tissue is unchanged unless `successful`."""

    def inherited(self, tree: Tree, *, axis: str | None = None) -> Tree:
        """An energy, or another pytree, with the entries of parents for new cells, edges and vertices.

        Fields declare their axes of cells, edges and vertices by their annotation, such as
        `Float[Array, "cells"]` or `Float[Array, "knots edges"]`, or by metadata,
        `eqx.field(metadata={"axis": "cells"})`, with None for no such axis. All other arrays stay unchanged,
        whatever their size, and so do tissues.

        **Arguments:**

        - `tree`: the pytree.
        - `axis`: the first axis of arrays without a declaration: `"cells"`, `"edges"` or `"vertices"`. Needed
            for arrays outside of modules.

        **Returns:** the pytree with the entries of new cells, edges and vertices.

        **Raises:**

        - `TypeError` without `axis`, for an array outside of modules, and for an undeclared array in an
            energy with as many entries as there are cells, edges or vertices.
        - `ValueError` for an array of another length than declared, or another `axis`.
        """
        check_choice("axis", axis, (*AXES, None))
        parents = {kind: getattr(self, kind) for kind in AXES}
        sizes = {kind: parent.shape[-1] for kind, parent in parents.items()}
        return gather(tree, parents, sizes, axis=axis, opaque=(Tissue,), strict=(AbstractEnergy,))


def unchanged(tissue: Tissue) -> Change:
    """The `Change` of an unchanged tissue."""
    numbers = lambda n: jnp.arange(n, dtype=tissue.topology.twin.dtype)
    return Change(
        tissue,
        numbers(tissue.n_cells),
        numbers(tissue.n_edges),
        numbers(tissue.n_vertices),
        RESULTS.successful,
    )
