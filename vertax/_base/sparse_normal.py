"""Normal distributions with sparse inverse covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array, csr_array, sparray
from scipy.sparse.linalg import splu

# Largest number of unknowns, of which the variances are computed without samples, and of those of a window.
_EXACT, _WINDOW = 2500, 800
# Number of parts that stand for a large system.
_PARTS = 4
# Number of samples for the variances of larger systems.
_SAMPLES = 64


class SparseNormal:
    """A normal distribution of mean 0, from its sparse inverse covariance."""

    def __init__(self, precision: csc_array, place: Float[np.ndarray, "unknowns 2"]):
        """Factorise the inverse covariance.

        **Arguments:**

        - `precision`: the inverse covariance, positive definite.
        - `place`: position of each unknown; unknowns that are far apart are weakly correlated.
        """
        self.precision, self.place = csc_array(precision), place
        self._factor = factorised(self.precision)

    def covariances(self, right: Float[np.ndarray, "unknowns *columns"]) -> np.ndarray:
        """The covariance matrix times vectors."""
        return self._factor.solve(right)

    def variances(self, rows: csr_array) -> Float[np.ndarray, " rows"]:
        r"""Variances of sums of a few unknowns that are near each other.

        Those of small systems are exact. Else the unknowns are divided into windows, and the variance is the
        mean over samples of the conditional one (Rao–Blackwell; Sidén, Lindgren, Bolin & Villani 2018,
        doi:10.1080/10618600.2017.1415782): with the unknowns $x_W$ of a window, of the inverse covariance
        $Q$, and $a \cdot x$ within the window,

        $$\mathrm{Var}(a \cdot x) = a^T Q_{WW}^{-1} a
          + \mathrm{Var}\left(a \cdot (x_W - Q_{WW}^{-1} (Q x)_W)\right),$$

        where the second term, small if the window is large, is estimated from 64 samples.

        **Arguments:**

        - `rows`: the coefficients of each sum.

        **Returns:** the variances.
        """
        rows = csr_array(rows)
        if len(self.place) <= _EXACT:
            return np.asarray(
                rows.multiply(self._factor.solve(rows.T.toarray()).T).sum(axis=1)
            ).ravel()
        samples = self._samples()
        pushed = self.precision @ samples
        counts = np.maximum(np.diff(rows.indptr), 1)
        block = np.zeros(len(self.place), int)
        parts = bisected(self.place, _WINDOW)
        for number, part in enumerate(parts):
            block[part] = number
        of_row = block[rows.indices[np.minimum(rows.indptr[:-1], rows.nnz - 1)]]
        variance = np.zeros(len(counts))
        pattern = csr_array(self.precision)
        for number, part in enumerate(parts):
            mine = np.flatnonzero((of_row == number) & (counts > 0))
            some = rows[mine]
            window = np.union1d(part, some.indices)
            for _ in range(2):
                window = np.unique(pattern[window].indices)
            factor = factorised(pattern[window][:, window])
            local = some[:, window]
            towards = factor.solve(local.T.toarray())
            mean = local @ samples[window] - towards.T @ pushed[window]
            inner = np.sum(local.T.multiply(towards), axis=0)
            variance[mine] = np.asarray(inner).ravel() + np.mean(mean**2, axis=1)
        return variance

    def _samples(self) -> Float[np.ndarray, "unknowns samples"]:
        # With Q = Pᵀ L D Lᵀ P, Q x = Pᵀ L D^(1/2) z for a standard normal z.
        z = np.random.default_rng(0).normal(size=(len(self.place), _SAMPLES))
        lower, scale = self._factor.L, np.sqrt(np.abs(self._factor.U.diagonal()))
        return self._factor.solve((lower @ (scale[:, None] * z))[self._factor.perm_r])


def factorised(matrix: sparray) -> Any:
    """The factors of a sparse symmetric matrix; their method `solve` takes right-hand sides."""
    return splu(
        csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def bisected(place: Float[np.ndarray, "points 2"], size: int) -> list[Int[np.ndarray, " some"]]:
    """Compact parts of at most `size` points."""
    parts, waiting = [], [np.arange(len(place))]
    while waiting:
        part = waiting.pop()
        if len(part) <= size:
            parts.append(part)
            continue
        axis = np.argmax(np.ptp(place[part], axis=0))
        order = part[np.argsort(place[part, axis], kind="stable")]
        waiting += [order[len(order) // 2 :], order[: len(order) // 2]]
    return parts


def spread_parts(
    place: Float[np.ndarray, "points 2"], complete: int, size: int
) -> list[Int[np.ndarray, " some"]]:
    """All points, or, of more than `complete`, a few parts of at most `size` points that are far apart."""
    if len(place) <= complete:
        return [np.arange(len(place))]
    parts = bisected(place, size)
    chosen = np.unique(np.linspace(0, len(parts) - 1, _PARTS).round().astype(int))
    return [parts[number] for number in chosen]
