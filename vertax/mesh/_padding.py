"""Tissues of nearly the same size, brought to one size."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from vertax._base.axes import gather
from vertax._base.checks import check_concrete
from vertax.mesh._capacity import size_class
from vertax.mesh._tissue import Tissue


def pad(tissue: Tissue, *parts: Any) -> Any:
    r"""A tissue with spare slots up to the next size class, so that similar sizes share compiled functions.

    ```python
    for mask in masks:
        tissue, energy = vx.mesh.pad(*from_mask(mask))
        relaxed = vx.equilibrate(tissue, energy).tissue.without_spare()
    ```

    JAX compiles a function anew for each size of its arguments. The size classes are
    $c_{k+1} = \lfloor \tfrac54 (c_k + 1) \rfloor$ with $c_0 = 4$ (4, 6, 8, 11, 15, 20, …, 85, 107, 135, …),
    so a tissue gets at most a quarter more cells than it has; below 4 cells it keeps its size. Spare slots
    have no area and feel no force, see [`with_capacity`][vertax.Tissue.with_capacity]. Cells, edges and
    vertices keep their numbers, and come before the spare ones.

    **Arguments:**

    - `tissue`: the tissue; its numbers must be known (not inside `jax.jit`).
    - `parts`: energies and other modules that belong to it. Their arrays with one entry for each cell, edge
        or vertex become longer by copies of the first entry. Fields declare which these are by their
        annotation, such as `Float[Array, "cells"]`, see [your own energy](../extending.md).

    **Returns:** the padded tissue; with parts, the tuple of the tissue and the padded parts.

    **Raises:**

    - `TypeError` inside `jax.jit`, and for an array of a part that has as many entries as there are cells,
        edges or vertices, and does not declare for which of them.
    - `ValueError` for an array of another length than its field declares.
    """
    check_concrete("pad", tissue.topology)
    padded = tissue.with_capacity(size_class(tissue.n_cells))
    if not parts:
        return padded
    sizes, parents = {}, {}
    for kind in ("cells", "edges", "vertices"):
        n, m = getattr(tissue, f"n_{kind}"), getattr(padded, f"n_{kind}")
        sizes[kind] = n
        parents[kind] = np.where(np.arange(m) < n, np.arange(m), 0)
    return padded, *(gather(part, parents, sizes, strict=(eqx.Module,)) for part in parts)
