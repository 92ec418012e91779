"""Accuracy of inferred parameters and neighbours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from vertax.mesh import Tissue

Values = Float[Array | np.ndarray, "..."]


def pearson(true: Values, inferred: Values) -> Float[np.ndarray, "..."]:
    """Pearson's correlation of inferred with true parameters.

    **Arguments:**

    - `true`, `inferred`: the parameters; leading axes are those of a batch.

    **Returns:** the correlation, of each member of a batch; NaN where the true or the inferred ones are
    all equal up to rounding.

    **Raises:**

    - `ValueError` if the shapes differ.
    """
    true, inferred = _alike(true, inferred)
    a, b = (x - x.mean(axis=-1, keepdims=True) for x in (true, inferred))
    size = np.sqrt(np.sum(a**2, axis=-1) * np.sum(b**2, axis=-1))
    # The variance of values that are constant up to rounding is rounding error.
    varies = [np.ptp(x, axis=-1) > 1e-12 * np.abs(x).max(axis=-1) for x in (true, inferred)]
    varied = varies[0] & varies[1]
    return np.where(varied, np.sum(a * b, axis=-1) / np.where(varied, size, 1.0), np.nan)


def relative_error(true: Values, inferred: Values) -> Float[np.ndarray, "..."]:
    r"""Mean of $|\theta - \theta_\mathrm{true}| / |\theta_\mathrm{true}|$ over the parameters.

    **Arguments:**

    - `true`, `inferred`: the parameters; leading axes are those of a batch.

    **Returns:** the error, of each member of a batch.

    **Raises:**

    - `ValueError` if the shapes differ.
    """
    true, inferred = _alike(true, inferred)
    return np.asarray(np.mean(np.abs(inferred - true) / np.abs(true), axis=-1))


def same_neighbours(tissue: Tissue, other: Tissue) -> bool:
    """Whether the same cells touch in two tissues, however their edges are numbered.

    **Arguments:**

    - `tissue`, `other`: the tissues; cells are compared by number.

    **Returns:** whether they do. [`mismatched_neighbours`][vertax.costs.mismatched_neighbours] counts the
    neighbourships that differ, for any numbering of the cells.
    """

    def pairs(t: Tissue) -> list[list[int]]:
        return sorted(np.sort(np.asarray(t.topology.edge_cells), axis=1).tolist())

    return pairs(tissue) == pairs(other)


def _alike(true: Values, inferred: Values) -> tuple[np.ndarray, np.ndarray]:
    true, inferred = np.asarray(true, float), np.asarray(inferred, float)
    if true.shape != inferred.shape or not true.ndim:
        raise ValueError(
            "Arguments `true` and `inferred` must be arrays of one shape, but have shapes "
            f"{true.shape} and {inferred.shape}."
        )
    return true, inferred
