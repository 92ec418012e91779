"""Padding of tissues to size classes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from vertax._base.axes import gather
from vertax._base.checks import check_concrete
from vertax.mesh._capacity import size_class
from vertax.mesh._tissue import Tissue


def pad(tissue: Tissue, *parts: Any) -> Any:
    r"""Add spare slots up to the next size class, so that tissues of similar size share compiled functions.

    ```python
    for mask in masks:
        tissue, energy = vx.mesh.pad(*from_mask(mask))
        relaxed = vx.equilibrate(tissue, energy).tissue.without_spare()
    ```

    JAX compiles a function again for each size of its arguments. The size classes are
    $c_{k+1} = \lfloor \tfrac54 (c_k + 1) \rfloor$ with $c_0 = 4$ (4, 6, 8, 11, 15, 20, …, 85, 107, 135, …),
    so padding adds at most 25 % to the number of cells; below 4 cells a tissue keeps its size. Spare slots
    have area 0 and force 0, see [`with_capacity`][vertax.Tissue.with_capacity]. Cells, edges and
    vertices keep their numbers; spare ones follow.

    **Arguments:**

    - `tissue`: the tissue, with concrete arrays (not inside `jax.jit`).
    - `parts`: energies and other modules of the tissue. Their arrays with one entry for each cell, edge or
        vertex are extended by copies of the first entry. Fields declare these axes by their annotation,
        such as `Float[Array, "cells"]`, see [your own energy](../extending.md).

    **Returns:** the padded tissue; with `parts`, a tuple of the padded tissue and the padded parts.

    **Raises:**

    - `TypeError` inside `jax.jit`, and for an undeclared array of a part with as many entries as there are
        cells, edges or vertices.
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
