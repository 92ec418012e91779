"""Accuracy of inferred parameters and neighbours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float, Int

from vertax.costs import mismatched_neighbours
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Record, member
from vertax.mesh import Tissue

Values = Float[Array | np.ndarray, "..."]


def pearson(true: Values, inferred: Values) -> Float[np.ndarray, "..."]:
    """Pearson's correlation of inferred with true parameters.

    **Arguments:**

    - `true`, `inferred`: the parameters; leading axes are those of a batch.

    **Returns:** the correlation, of each member of a batch; NaN where the true or the inferred ones are
    all equal.

    **Raises:**

    - `ValueError` if the shapes differ.
    """
    true, inferred = _alike(true, inferred)
    a, b = (x - x.mean(axis=-1, keepdims=True) for x in (true, inferred))
    size = np.sqrt(np.sum(a**2, axis=-1) * np.sum(b**2, axis=-1))
    varied = (np.ptp(true, axis=-1) > 0) & (np.ptp(inferred, axis=-1) > 0)
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


class RecoveryWatch:
    """A callback of [`fit`][vertax.fit] that records the accuracy in each epoch.

    For batches of problems with a [`ShapeFactorEnergy`][vertax.energies.ShapeFactorEnergy]: the
    records are `pearson`, the correlation of the inferred with the true shape factors, and `mismatched`, the
    number of neighbourships that differ from those of the target.

    **Arguments:**

    - `truth`: the true energies, a batch.
    - `targets`: the target tissues, a batch.
    """

    def __init__(self, truth: ShapeFactorEnergy, targets: Tissue):
        self._true = np.asarray(truth.target_shape_factor)
        self._targets = [member(targets, k) for k in range(len(self._true))]
        self._counts: list[tuple[Int[np.ndarray, " halfedges"], int] | None] = [None] * len(
            self._true
        )

    def __call__(self, epoch: int, record: Record) -> dict[str, np.ndarray]:
        """The records of an epoch."""
        inferred = np.asarray(record.parameters.target_shape_factor)
        cells = np.asarray(record.tissue.topology.cell)
        mismatched = [self._count(k, record, row) for k, row in enumerate(cells)]
        return {"pearson": pearson(self._true, inferred), "mismatched": np.asarray(mismatched)}

    def _count(self, k: int, record: Record, cells: Int[np.ndarray, " halfedges"]) -> int:
        # Most epochs have no T1 transition, and the assignment of cells takes a while.
        latest = self._counts[k]
        if latest is None or not np.array_equal(latest[0], cells):
            count = mismatched_neighbours(member(record.tissue, k), self._targets[k])
            self._counts[k] = latest = (cells, count)
        return latest[1]


def _alike(true: Values, inferred: Values) -> tuple[np.ndarray, np.ndarray]:
    true, inferred = np.asarray(true, float), np.asarray(inferred, float)
    if true.shape != inferred.shape or not true.ndim:
        raise ValueError(
            "Arguments `true` and `inferred` must be arrays of one shape, but have shapes "
            f"{true.shape} and {inferred.shape}."
        )
    return true, inferred
