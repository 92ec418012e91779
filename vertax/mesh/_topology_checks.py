"""Checks of the arrays of a topology."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Shaped


def check_half_edge_arrays(
    twin: Shaped[Array | np.ndarray, "..."],
    cell: Shaped[Array | np.ndarray, "..."],
    frame: Shaped[Array | np.ndarray, "..."],
    *,
    concrete: bool,
) -> None:
    """Check shapes, dtypes and values of the arrays of half-edges.

    **Arguments:**

    - `twin`, `cell`, `frame`: as for [`Topology`][vertax.Topology].
    - `concrete`: whether the arrays are concrete; for tracers only shapes and dtypes are checked.

    **Raises:**

    - `ValueError` with the name of the argument.
    """
    if twin.ndim != 1 or twin.size == 0 or twin.size % 6 != 0:
        raise ValueError(
            "Argument `twin` must list three half-edges for each of an even number of vertices, "
            f"but its shape is {twin.shape}."
        )
    n_half = twin.size
    for name, array, shape in (
        ("twin", twin, (n_half,)),
        ("cell", cell, (n_half,)),
        ("frame", frame, (n_half, 2)),
    ):
        if array.dtype.kind not in "iu":
            raise ValueError(
                f"Argument `{name}` must hold integers, but its type is {array.dtype}."
            )
        if array.shape != shape:
            what = "two entries" if len(shape) == 2 else "one entry"
            raise ValueError(
                f"Argument `{name}` must have {what} for each half-edge, shape {shape}, but its shape is "
                f"{array.shape}."
            )
    if not concrete:
        return
    h = np.arange(n_half)
    if twin.min() < 0 or twin.max() >= n_half or np.any(twin[twin] != h):
        raise ValueError("Argument `twin` must be an involution: twin[twin[h]] == h.")
    if np.any(twin == h):
        raise ValueError(
            f"Argument `twin` must not have fixed points, but half-edge {np.argmax(twin == h)} is "
            "its own twin."
        )
    if cell.min() < 0 or cell.max() >= n_half:
        raise ValueError(
            "Argument `cell` must give each half-edge a number in 0 … n_cells - 1, of which there are "
            f"fewer than half-edges, but goes from {cell.min()} to {cell.max()}."
        )
    limits = np.iinfo(np.int32)
    if frame.min() < limits.min or frame.max() > limits.max:
        raise ValueError(
            "Argument `frame` must hold lattice images in the range of 32-bit integers, but goes from "
            f"{frame.min()} to {frame.max()}."
        )
