"""Accuracy of inferred shape factors during fits."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from vertax.costs import mismatched_neighbours
from vertax.energies import ShapeFactorEnergy
from vertax.fitting import Record, member
from vertax.inference import pearson
from vertax.mesh import Tissue


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
        self._counts: list[tuple[Int[np.ndarray, " halfedges"], int] | None] = [None] * len(self._true)

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
