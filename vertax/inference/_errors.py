"""Sizes of the errors of noise and model, estimated from the residual forces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular
from scipy.optimize import minimize

# Smallest errors of the model, in radians: of angles at junctions, and of arcs of the length of a cell;
# largest.
LEAST = (0.005, 0.02)
_MOST = 1.5


class Errors(NamedTuple):
    """Sizes of errors; or the covariance of the forces for each error of size 1."""

    junction: Float[np.ndarray, "*shape"] | float
    """Angles at junctions, radians."""
    arc: Float[np.ndarray, "*shape"] | float
    """Angles of arcs of the length of a cell, radians."""
    noise: Float[np.ndarray, "*shape"] | float
    """Noise relative to that of the points."""


def model_errors(
    matrix: Float[np.ndarray, "rows unknowns"],
    given: Float[np.ndarray, " rows"],
    parts: Errors,
    unknown: Float[np.ndarray, "rows rows"],
    guess: Errors,
    shares: tuple[float, float],
) -> Errors:
    """The errors by restricted maximum likelihood (Patterson & Thompson 1971, doi:10.1093/biomet/58.3.545).

    The combinations N of the equations without unknowns, Nᵀ A = 0, have the covariance Nᵀ S N.

    **Arguments:**

    - `matrix`: A, the forces of unit tensions and pressures.
    - `given`: forces without them.
    - `parts`: covariance of the forces for each error of size 1.
    - `unknown`: covariance of unknown forces.
    - `guess`: initial errors.
    - `shares`: logarithms of the smallest and largest noise relative to that of the points.

    **Returns:** the [`Errors`][vertax.inference._errors.Errors].
    """
    factors: Any = qr(matrix, pivoting=True)  # (the type is missing in SciPy's overloads)
    orthogonal, upper, _ = factors
    size = np.abs(np.diag(upper))
    free = orthogonal[:, int(np.sum(size > 1e-9 * size[0])) :]
    z = free.T @ given
    loose, junction, arc, noise = (free.T @ part @ free for part in (unknown, *parts))

    def loss(logs: np.ndarray) -> float:
        ratio = np.exp(2 * logs)
        factor = np.linalg.cholesky(loose + ratio[0] * junction + ratio[1] * arc + ratio[2] * noise)
        left = solve_triangular(factor, z, lower=True)
        return left @ left + 2 * np.sum(np.log(np.diag(factor))) + logs[2] ** 2

    bounds = [(np.log(least), np.log(_MOST)) for least in LEAST] + [shares]
    first = np.clip(np.log(np.array(guess)), *np.transpose(bounds))
    options = {"xatol": 0.05, "fatol": 0.02}
    optimum = minimize(loss, first, method="Nelder-Mead", bounds=bounds, options=options)
    return Errors(*np.exp(optimum.x).tolist())
