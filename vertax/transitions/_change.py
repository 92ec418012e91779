"""What becomes of a tissue when a cell comes or goes."""

from __future__ import annotations

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vertax._base.axes import AXES, Declaration, declarations
from vertax._base.modules import is_concrete
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
        declared = declarations(tree, (Tissue,))
        leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: isinstance(x, Tissue))
        pairs = zip(leaves, declared, strict=True)
        return jax.tree.unflatten(structure, [self._of(x, field, axis) for x, field in pairs])

    def _of(self, x: Any, field: Declaration | None, default: str | None) -> Any:
        """A leaf, of which a field declares something, with the entries of new cells, edges and vertices."""
        if not isinstance(x, jax.Array | np.ndarray) or x.ndim == 0:
            return x
        name = (
            "Argument `tree`"
            if field is None
            else f"Field `{field.field}` of {field.owner.__name__}"
        )
        if field is not None and field.shapes is not None:
            axes = field.axes(x.ndim)
        elif default is not None:
            axes = {0: default}
        elif field is None:
            raise TypeError(
                f"{name} must hold its arrays in fields of modules, which declare what has one entry for "
                'each cell, edge or vertex, but holds one outside. Pass axis="cells", "edges" or "vertices".'
            )
        else:
            self._check_undeclared(name, x, field)
            axes = {}
        for at, kind in axes.items():
            parent: Array = getattr(self, kind)
            size = parent.shape[-1]
            if x.shape[at] != size:
                raise ValueError(
                    f"{name} must have one entry for each of {size} {kind} along its axis {at}, but its "
                    f'shape is {x.shape}. If it has not, declare it: eqx.field(metadata={{"axis": None}}).'
                )
            concrete = isinstance(x, np.ndarray) and is_concrete(parent)
            x = np.take(x, np.asarray(parent), at) if concrete else _taken(x, parent, at)
        return x

    def _check_undeclared(self, name: str, x: Array | np.ndarray, field: Declaration) -> None:
        sizes = {getattr(self, kind).shape[-1]: kind for kind in reversed(AXES)}
        if issubclass(field.owner, AbstractEnergy) and x.shape[0] in sizes:
            kind = sizes[x.shape[0]]
            raise TypeError(
                f"{name} must declare whether it has one entry for each of the {kind}, of which there are as "
                f'many, but does not. Annotate it, {field.field}: Float[Array, "{kind}"], or '
                'eqx.field(metadata={"axis": None}).'
            )


def _taken(x: Array | np.ndarray, parent: Int[Array, " n"], axis: int) -> Array:
    # (Indexed, and not by `jnp.take`: keys of random numbers may be indexed.)
    return jnp.asarray(x)[(slice(None),) * axis + (parent,)]


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


def raised_if(change: Change, wrong: Bool[Array, ""], reason: str) -> Change:
    """The change, or an error."""
    if not is_concrete(wrong):
        return eqx.error_if(change, wrong, reason)
    if np.any(np.asarray(wrong)):
        raise RuntimeError(reason)
    return change
