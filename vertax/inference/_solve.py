"""Tensions and pressures in balance, and the angles nearest to those observed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import nnls
from scipy.sparse import csr_array
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
from vertax.inference._errors import Errors, most_evident
from vertax.inference._observed_geometry import ObservedGeometry

# An edge is loose if the standard deviation of its direction, in radians, is larger than the first, or if it
# is shorter than the second times the noise. Its force has the third as standard deviation, in mean tensions.
_LOOSE, _SHORT, _UNKNOWN = 0.2, 8.0, 10.0
# Smallest tension in the covariance of the forces.
_SMALL = 0.2
# Initial standard deviations.
_FIRST = Errors(0.05, 0.1, 0.1, 0.3, 1.0, 0.5, 1.0)
# Smallest and largest ones (angles in radians, bends relative, priors in mean tensions).
_ANGLES, _RATIOS, _TENSIONS, _PRESSURES = (1e-3, 1.5), (1e-2, 10.0), (0.03, 3.0), (0.01, 10.0)
# Smallest noise relative to that of the points, of smooth and of rough outlines, and the largest: pixels
# along a straight line deviate from it by a pattern that averages out, rough outlines do not.
_LESS, _ROUGH_LESS, _MORE = 0.1, 0.7, 2.0
# The same for vertices of straight edges without an image, whose noise is not known beforehand.
_VERTICES = (0.01, 50.0)
# Iterations of the first and of the second estimate of the errors.
_STEPS = (25, 10)
# Bends larger than this, in radians, are errors of arcs.
_BENT = 1e-3
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
    bend: Float[np.ndarray, " angles"]
    """Size of the bend beyond the arc: of directions at their end, of arcs of both ends."""
    bounds: dict[str, tuple[float, float]]
    """Smallest and largest standard deviations of errors and priors."""


class Balance(NamedTuple):
    """The solution of the balance of forces."""

    tension: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Covariance of tensions and pressures."""
    angle: Float[np.ndarray, " angles"]
    """The angles with which all forces balance."""
    errors: Errors
    """Errors of the model, noise relative to that of the points, and widths of the priors."""
    evidence: float
    """Logarithm of the density of the observed angles, up to a constant of the tissue."""
    residual: Float[np.ndarray, " rows"]
    """Residual forces with the observed angles, over their standard deviations."""
    loose: Bool[np.ndarray, " edges"]
    """Edges too short for a direction."""


def observability(
    fitted: ObservedGeometry,
    curves: Fitted,
    which: Equations,
    uncertain: Bool[np.ndarray, " all_edges"],
    *,
    prior: float | None,
    exact: bool,
) -> Observability:
    """The observed angles of a shape, and their covariance.

    **Arguments:**

    - `fitted`, `curves`: the geometry and the noise.
    - `which`: the equations.
    - `uncertain`: edges that may be between other cells; they are loose, as those without a direction.
    - `prior`: standard deviation of tensions about 1; by default chosen by the evidence.
    - `exact`: whether the noise is at most that of the points.
    """
    slope = angle_slopes(fitted, which)
    covariance = curves.noise**2 * (slope @ splu(curves.precision).solve(slope.T.toarray()))
    variance = np.zeros(len(which.edges))
    np.maximum.at(variance, which.half_edge.ravel(), np.diag(covariance)[: which.n_directions])
    loose = (variance > _LOOSE**2) | (which.chord < _SHORT * curves.noise)
    loose |= uncertain[which.edges]
    unknown = pulls(fitted, which, loose)
    end_bend = np.stack([fitted.bend.sum(axis=1), fitted.bend[:, 0] - fitted.bend[:, 1]], axis=1)
    edge, forward = fitted.half_edge[which.junctions], fitted.forward[which.junctions]
    bend = np.where(forward, end_bend[edge, 0], end_bend[edge, 1]).ravel()
    least = _LESS if curves.crisp else _ROUGH_LESS
    bounds = {"junction": _ANGLES, "noise": (least, 1.0 if exact else _MORE)}
    bounds["pressure"] = _PRESSURES
    if prior is None:
        bounds["tension"] = _TENSIONS
    if which.n_arcs:
        bend = np.append(bend, np.linalg.norm(fitted.bend[which.edges], axis=1))
        bounds["arc"] = _ANGLES
        if curves.bending > _BENT:
            bounds |= {"bend": _RATIOS, "bent_arc": _RATIOS}
    return Observability(
        angle=angles(fitted, which),
        covariance=covariance,
        length=np.maximum(which.chord / fitted.size, 0.05),
        loose=loose,
        unknown=_UNKNOWN**2 * unknown @ unknown.T,
        size=fitted.size,
        bend=np.abs(bend),
        bounds=bounds,
    )


# Observed are angles a with the covariance C, from the noise of points. Where the tissue is not in balance,
# angles differ from those of a balance as well, the more the more an edge bends beyond an arc.
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
    prior: float | None,
    errors: Errors | None = None,
    rounds: int = 8,
) -> Balance:
    """Tensions and pressures in balance.

    **Arguments:**

    - `shape`: the observed angles.
    - `which`: the equations.
    - `prior`: standard deviation of tensions about 1; by default chosen by the evidence.
    - `errors`: errors of model and noise, and widths of priors; by default chosen by the evidence.
    - `rounds`: largest number of adjustments of the angles.

    **Returns:** the [`Balance`][vertax.inference._solve.Balance].
    """
    n_edges, n_cells, loose = len(which.edges), len(which.cells), shape.loose
    x = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    change = np.zeros(len(shape.angle))
    # Prior means: tensions of 1, and pressures of 0.
    expected = x.copy()
    mean = np.append(~loose, np.zeros(n_cells, bool)) / max(1, np.sum(~loose))
    has_errors, evidence = errors is not None, np.nan
    if errors is None:
        absent = {name: 0.0 for name in Errors._fields if name not in shape.bounds}
        errors = _FIRST._replace(**absent | ({} if prior is None else {"tension": prior}))
    diagonals = _diagonals(shape, which)
    covariance = residual = np.zeros(0)
    for attempt in range(rounds):
        matrix = forces(shape.angle + change, which, loose)
        slope = force_slopes(shape.angle + change, which, np.maximum(x[:n_edges], _SMALL))
        offset = -slope @ change
        if attempt in (2, 4) and not has_errors:
            errors, evidence = most_evident(
                matrix @ expected + offset,
                _parts(matrix, slope, shape, diagonals, mean),
                shape.unknown,
                errors,
                shape.bounds,
                steps=_STEPS[attempt // 4],
            )
        spread = errors.noise**2 * shape.covariance
        spread += np.diag(model_deviations(errors, shape, which) ** 2)
        answer = (slope @ spread).T
        factor = np.linalg.cholesky(slope @ answer + shape.unknown)
        deviation = np.repeat([errors.tension, errors.pressure / shape.size], [n_edges, n_cells])
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
        if attempt > (1 if has_errors else 4) and np.max(np.abs(x - before)[:n_edges]) < 1e-3:
            break
    return Balance(
        tension=x[:n_edges],
        pressure=x[n_edges:],
        covariance=covariance,
        angle=shape.angle + change,
        errors=errors,
        evidence=evidence,
        residual=residual,
        loose=loose,
    )


def model_deviations(
    errors: Errors, shape: Observability, which: Equations
) -> Float[np.ndarray, " angles"]:
    """Standard deviations of the angles due to errors of the model."""
    parts = zip(errors, _diagonals(shape, which), strict=False)
    return np.sqrt(sum((e**2 * d for e, d in parts), np.zeros(len(shape.angle))))


def _diagonals(shape: Observability, which: Equations) -> list[Float[np.ndarray, " angles"]]:
    """Variances of the angles for each error of the model of size 1, in the order of `Errors`."""
    at_junctions = np.arange(len(shape.angle)) < which.n_directions
    along = np.zeros(len(shape.angle))
    along[which.n_directions :] = shape.length[: which.n_arcs] ** 2
    bend = shape.bend**2
    return [at_junctions * 1.0, at_junctions * bend, along, ~at_junctions * bend]


def _parts(
    matrix: Float[np.ndarray, "rows unknowns"],
    slope: csr_array,
    shape: Observability,
    diagonals: list[Float[np.ndarray, " angles"]],
    mean: Float[np.ndarray, " unknowns"],
) -> Errors:
    """Covariances of the forces for each standard deviation of 1."""
    of_angles = [(slope * d @ slope.T).toarray() for d in diagonals]
    n_edges = len(shape.loose)
    pull, push = matrix[:, :n_edges], matrix[:, n_edges:] / shape.size
    # The mean tension is 1.
    common = matrix @ mean / np.linalg.norm(mean)
    return Errors(
        *of_angles,
        noise=slope @ (slope @ shape.covariance).T,
        tension=pull @ pull.T - np.outer(common, common),
        pressure=push @ push.T,
    )


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
