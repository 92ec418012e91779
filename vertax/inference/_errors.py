"""How large the errors of noise and model are, as forces that are left tell."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular
from scipy.optimize import minimize

# No tissue is a foam better than that: a third of a degree, and an arc of 1 per cent of a cell.
LEAST = (0.005, 0.02)
_MOST = 1.5


class Errors(NamedTuple):
    """Sizes of errors; or the covariances of forces that each makes where it is 1."""

    junction: Float[np.ndarray, "*shape"] | float
    """Angles at junctions, radians."""
    arc: Float[np.ndarray, "*shape"] | float
    """Angles of arcs of the length of a cell, radians."""
    noise: Float[np.ndarray, "*shape"] | float
    """Noise over that of the points."""


def model_errors(
    matrix: Float[np.ndarray, "rows unknowns"],
    given: Float[np.ndarray, " rows"],
    parts: Errors,
    unknown: Float[np.ndarray, "rows rows"],
    guess: Errors,
    shares: tuple[float, float],
) -> Errors:
    """The errors by restricted maximum likelihood (Patterson & Thompson 1971, doi:10.1093/biomet/58.3.545).

    Combinations of the equations in which no unknown is left, N, have the covariance Nᵀ S N.

    **Arguments:**

    - `matrix`: forces of tensions and pressures.
    - `given`: forces without them.
    - `parts`: the covariance of the forces that each error makes.
    - `unknown`: that of forces which are not known.
    - `guess`: errors to begin with.
    - `shares`: least and largest noise over that of the points, logarithms.

    **Returns:** the [`Errors`][vertax.inference._errors.Errors].
    """
    factors: Any = qr(matrix, pivoting=True)  # (of SciPy's overloads none says so)
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
    found = minimize(loss, first, method="Nelder-Mead", bounds=bounds, options=options)
    return Errors(*np.exp(found.x).tolist())
