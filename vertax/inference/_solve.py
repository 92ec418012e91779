"""Tensions and pressures in balance, and the angles nearest to those observed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import nnls
from scipy.sparse.linalg import splu

from vertax.inference._balance import (
    Equations,
    angle_slopes,
    angles,
    force_slopes,
    forces,
    pulls,
)
from vertax.inference._curves import Fitted
from vertax.inference._errors import Errors, model_errors
from vertax.inference._observed_geometry import ObservedGeometry

# An edge is loose if the standard deviation of its direction, in radians, is larger than the first, or if it
# is shorter than the second times the noise. Its force has the third as standard deviation, in mean tensions.
_LOOSE, _SHORT, _UNKNOWN = 0.2, 8.0, 10.0
# Prior standard deviation of pressures, in mean tensions over a cell diameter.
_PRESSURE = 10.0
# Width of the prior of tensions over their spread; smallest and largest width; initial width.
_TIMES, _WIDTHS, _START = 2.0, (0.3, 3.0), 0.5
# Smallest tension in the covariance of the forces.
_SMALL = 0.2
_FIRST = Errors(0.05, 0.5, 1.0)
# Logarithms of the smallest noise relative to that of the points, of smooth and of rough outlines, and of the
# largest: pixels along a straight line deviate from it by a pattern that averages out, rough outlines do not.
_LESS, _ROUGH_LESS, _MORE = -2.3, -0.35, 0.7
# Error of arcs, in radians, above which their weight decreases.
_ARCS = 0.02
# Largest adjustment of an angle, in radians.
_REACH = 0.5


class Observability(NamedTuple):
    """The observed angles of a shape, their covariance, and which forces they determine."""

    angle: Float[np.ndarray, " angles"]
    """Directions at junctions, and angles of arcs."""
    covariance: Float[np.ndarray, "angles angles"]
    """Covariance of the angles due to the noise of points."""
    length: Float[np.ndarray, " edges"]
    """Lengths of chords, in cell diameters."""
    loose: Bool[np.ndarray, " edges"]
    """Edges too short for a direction."""
    unknown: Float[np.ndarray, "rows rows"]
    """Covariance of the unknown forces of loose edges. The force at one end is opposite to that at the
    other, so that the balance of both ends together remains."""
    size: float
    """Root of the mean area of a cell."""
    least_noise: float
    """Logarithm of the smallest noise relative to that of the points."""


class Balance(NamedTuple):
    """The solution of the balance of forces."""

    tension: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Covariance of tensions and pressures."""
    angle: Float[np.ndarray, " angles"]
    """The angles with which all forces balance."""
    errors: Errors
    """Errors of the model, beyond noise, and the noise estimated from forces, relative to that of the
    points."""
    residual: Float[np.ndarray, " rows"]
    """Residual forces with the observed angles, over their standard deviations."""
    loose: Bool[np.ndarray, " edges"]
    """Edges too short for a direction."""


def observability(
    fitted: ObservedGeometry,
    curves: Fitted,
    which: Equations,
    uncertain: Bool[np.ndarray, " all_edges"],
) -> Observability:
    """The observed angles of a shape, and their covariance.

    `uncertain` marks edges that may be between other cells; they are loose, as those without a direction.
    """
    slope = angle_slopes(fitted, which)
    covariance = curves.noise**2 * (slope @ splu(curves.precision).solve(slope.T.toarray()))
    variance = np.zeros(len(which.edges))
    np.maximum.at(variance, which.half_edge.ravel(), np.diag(covariance)[: which.n_directions])
    loose = (variance > _LOOSE**2) | (which.chord < _SHORT * curves.noise)
    loose |= uncertain[which.edges]
    unknown = pulls(fitted, which, loose)
    return Observability(
        angle=angles(fitted, which),
        covariance=covariance,
        length=np.maximum(which.chord / fitted.size, 0.05),
        loose=loose,
        unknown=_UNKNOWN**2 * unknown @ unknown.T,
        size=fitted.size,
        least_noise=_LESS if curves.crisp else _ROUGH_LESS,
    )


# Observed are angles a with the covariance C, from the noise of points. Where the tissue is not in balance,
# angles differ from those of a balance as well, which adds τ² to their covariance.
# Forces r(x, a) = A(a) x are linear in the unknowns x. To first order their covariance is S = J C Jᵀ with
# J = ∂r/∂a. Weighted least squares with fixed a would shrink the unknowns, because the noise of A and of r is
# the same. So a is adjusted as well (total least squares: Britt & Luecke 1973,
# doi:10.1080/00401706.1973.10489060): linearised at (x, a),
#
#     x' minimises (A x' - J d)ᵀ S⁻¹ (A x' - J d) + prior,      d' = - C Jᵀ S⁻¹ (A x' - J d),
#
# where d = a - a_observed. When it has converged, all forces balance with the adjusted angles.
def solve(
    shape: Observability,
    which: Equations,
    *,
    exact: bool,
    prior: float | None,
    errors: Errors | None = None,
    rounds: int = 8,
) -> Balance:
    """Tensions and pressures in balance.

    **Arguments:**

    - `shape`: the observed angles.
    - `which`: the equations.
    - `exact`: whether the noise is at most that of the points.
    - `prior`: standard deviation of tensions about 1; by default twice the spread of those determined.
    - `errors`: errors of model and noise; by default estimated from the forces.
    - `rounds`: largest number of adjustments of the angles.

    **Returns:** the [`Balance`][vertax.inference._solve.Balance].
    """
    n_edges, n_cells, loose = len(which.edges), len(which.cells), shape.loose
    x = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    change = np.zeros(len(shape.angle))
    # Prior means: tensions of 1, and pressures of 0.
    expected = x.copy()
    width = prior or _START
    mean = np.append(~loose, np.zeros(n_cells, bool)) / max(1, np.sum(~loose))
    at_junctions, along = np.zeros_like(change), np.zeros_like(change)
    at_junctions[: which.n_directions] = 1.0
    along[which.n_directions :] = shape.length**2
    has_errors, shares = errors is not None, (shape.least_noise, 0.0 if exact else _MORE)
    errors = _FIRST if errors is None else errors
    covariance = residual = np.zeros(0)
    for attempt in range(rounds):
        matrix = forces(shape.angle + change, which, loose)
        slope = force_slopes(shape.angle + change, which, np.maximum(x[:n_edges], _SMALL))
        offset = -slope @ change
        if attempt in (2, 4) and not has_errors:
            parts = Errors(
                (slope * at_junctions @ slope.T).toarray(),
                (slope * along @ slope.T).toarray(),
                slope @ (slope @ shape.covariance).T,
            )
            basis = np.linalg.svd(mean[None])[2][1:].T
            left_over = matrix @ expected + offset
            errors = model_errors(matrix @ basis, left_over, parts, shape.unknown, errors, shares)
        # Arcs out of balance are not random errors: friction acts on weak edges otherwise than on strong
        # ones, which biases tensions before it shows in the residuals. So their weight is reduced.
        arc = errors.arc * np.sqrt(1 + (errors.arc / _ARCS) ** 2)
        spread = errors.noise**2 * shape.covariance + np.diag(
            errors.junction**2 * at_junctions + arc**2 * along
        )
        answer = (slope @ spread).T
        factor = np.linalg.cholesky(slope @ answer + shape.unknown)
        deviation = np.append(np.full(n_edges, width), np.full(n_cells, _PRESSURE / shape.size))
        white = solve_triangular(factor, np.column_stack([matrix, offset]), lower=True)
        white, given = white[:, :-1], white[:, -1]
        normal = white.T @ white + np.diag(deviation**-2.0)
        heavy = 1e3 * np.trace(normal) / len(normal) * n_edges
        normal += heavy * np.outer(mean, mean)
        right = -white.T @ given + expected / deviation**2 + heavy * mean
        root = cho_factor(normal)
        before, x = x, cho_solve(root, right)
        if np.any(x[:n_edges] < 0):
            x = _not_negative(normal, right, n_edges)
        residual = white @ x + given
        change = -answer @ solve_triangular(factor, residual, lower=True, trans=1)
        change *= min(1.0, _REACH / max(float(np.max(np.abs(change))), 1e-300))
        covariance = cho_solve(root, np.eye(len(x)))
        # Only in the first rounds: where noise is large, tensions could drift with the prior.
        if prior is None and attempt < 2:
            width = _varied(x[:n_edges][~loose], np.diag(covariance)[:n_edges][~loose])
        if attempt > (1 if has_errors else 4) and np.max(np.abs(x - before)[:n_edges]) < 1e-3:
            break
    return Balance(
        tension=x[:n_edges],
        pressure=x[n_edges:],
        covariance=covariance,
        angle=shape.angle + change,
        errors=errors,
        residual=residual,
        loose=loose,
    )


def _varied(tension: Float[np.ndarray, " edges"], variance: Float[np.ndarray, " edges"]) -> float:
    """Width of the prior of tensions: twice their spread, because tensions may be correlated over many
    cells, and the prior treats them as independent."""
    weight = 1 / (variance + 0.05)
    spread = np.sum(weight * ((tension - 1) ** 2 - variance)) / max(np.sum(weight), 1e-300)
    return float(np.clip(_TIMES * np.sqrt(max(spread, 0.0)), *_WIDTHS))


def _not_negative(
    normal: Float[np.ndarray, "n n"], right: Float[np.ndarray, " n"], n: int
) -> Float[np.ndarray, " n"]:
    """The solution of normal equations with the constraint that the first `n` entries are not negative."""
    # The others are eliminated.
    other = cho_factor(normal[n:, n:])
    through = cho_solve(other, np.column_stack([normal[n:, :n], right[n:]]))
    reduced = normal[:n, :n] - normal[:n, n:] @ through[:, :-1]
    root = np.linalg.cholesky(0.5 * (reduced + reduced.T))
    goal = solve_triangular(root, right[:n] - normal[:n, n:] @ through[:, -1], lower=True)
    first = nnls(root.T, goal, maxiter=50 * n)[0]
    return np.concatenate([first, through[:, -1] - through[:, :-1] @ first])
