"""Tensions and pressures in balance, and the angles nearest to those observed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import nnls
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from vertax.tensions._balance import (
    Equations,
    angle_slopes,
    angles,
    force_slopes,
    forces,
    pulls,
)
from vertax.tensions._curves import Fitted
from vertax.tensions._errors import Errors, most_evident
from vertax.tensions._observed_geometry import ObservedGeometry

# An edge is loose if the standard deviation of its direction, in radians, is larger than the first, or if it
# is shorter than the second times the noise, or the third times the size of a cell. Its force has the fourth
# as standard deviation, in mean tensions.
_LOOSE, _SHORT, _TINY, _UNKNOWN = 0.2, 8.0, 0.02, 10.0
# Smallest tension in the covariance of the forces.
_SMALL = 0.2
# Initial standard deviations; the pressures of arcs keep theirs, because the evidence underestimates it where
# arcs lag behind the pressures.
_FIRST = Errors(junction=0.05, arc=0.1, noise=1.0, tension=0.3, region=0.3, pressure=1.0)
# Smallest and largest ones: of directions and arcs in radians, of pressures, and of tensions in mean
# tensions. Tensions that are not negative and uniform about a mean of 1 have 0.58. Of arcs in noise, the
# evidence underestimates the independent part.
_JUNCTIONS, _ARCS, _PRESSURES = (5e-3, 1.5), (1e-3, 1.5), (0.01, 10.0)
_STRAIGHT_JUNCTIONS = (1e-3, 1.5)
_TENSIONS, _ARC_TENSIONS = (0.03, 0.6), (0.3, 0.6)
# Length of an edge, in cell diameters, below which the error of its arc does not decrease.
_SHORTEST = 0.25
# The errors of arcs are forces of friction along the edges. Only their sums around junctions contradict a
# balance; the rest, which is as large or larger, changes pressures and is not in the residual.
HIDDEN = 2.0
# Range of the correlation of tensions: κ² in the covariance (L + κ²)⁻², with L the Laplacian of edges that
# meet at junctions. The correlation decreases over about √8 / κ edges.
_KAPPA = 0.2
# Smallest noise relative to that of the points, of smooth and of rough outlines, and the largest: pixels
# along a straight line deviate from it by a pattern that averages out, rough outlines do not.
_LESS, _ROUGH_LESS, _MORE = 0.1, 0.7, 2.0
# The same for vertices of straight edges without an image, with a noise that is not known beforehand.
_VERTICES = (0.01, 50.0)
# Iterations of the first and of the second estimate of the errors.
_STEPS = (25, 10)
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
    known_noise: bool,
) -> Observability:
    """The observed angles of a shape, and their covariance.

    **Arguments:**

    - `fitted`, `curves`: the geometry and the noise.
    - `which`: the equations.
    - `uncertain`: edges that may be between other cells; they are loose, as those without a direction.
    - `prior`: standard deviation of tensions about 1; by default chosen by the evidence.
    - `known_noise`: whether the noise is at most that of the points.
    """
    slope = angle_slopes(fitted, which)
    covariance = curves.noise**2 * (slope @ splu(curves.precision).solve(slope.T.toarray()))
    variance = np.zeros(len(which.edges))
    np.maximum.at(variance, which.half_edge.ravel(), np.diag(covariance)[: which.n_directions])
    least = max(_SHORT * curves.noise, _TINY * fitted.size)
    loose = (variance > _LOOSE**2) | (which.chord < least)
    loose |= uncertain[which.edges]
    unknown = pulls(fitted, which, loose)
    smallest = _LESS if curves.crisp else _ROUGH_LESS
    noise = _VERTICES if len(curves.rest) == 0 else (smallest, _MORE)
    bounds = {"noise": (noise[0], 1.0 if known_noise else noise[1])}
    if which.n_arcs:
        bounds |= {"junction": _JUNCTIONS, "arc": _ARCS}
    else:
        bounds |= {"junction": _STRAIGHT_JUNCTIONS, "pressure": _PRESSURES}
    if prior is None:
        bounds |= {"tension": _ARC_TENSIONS if which.n_arcs else _TENSIONS, "region": _TENSIONS}
    return Observability(
        angle=angles(fitted, which),
        covariance=covariance,
        length=which.chord / fitted.size,
        loose=loose,
        unknown=_UNKNOWN**2 * unknown @ unknown.T,
        size=fitted.size,
        bounds=bounds,
    )


# Observed are angles a with the covariance C, from the noise of points. Where the tissue is not in balance,
# angles differ from those of a balance as well.
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

    **Returns:** the [`Balance`][vertax.tensions._solve.Balance].
    """
    n_edges, n_cells, loose = len(which.edges), len(which.cells), shape.loose
    x = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    change = np.zeros(len(shape.angle))
    # Prior means: tensions of 1, and pressures of 0.
    expected = x.copy()
    mean = np.append(~loose, np.zeros(n_cells, bool)) / max(1, np.sum(~loose))
    has_errors, evidence = errors is not None, np.nan
    if errors is None:
        errors = _FIRST if which.n_arcs else _FIRST._replace(arc=0.0)
        if prior is not None:
            errors = errors._replace(tension=prior, region=0.0)
    regions = _regions(which)
    covariance = residual = np.zeros(0)
    for attempt in range(rounds):
        matrix = forces(shape.angle + change, which, loose)
        slope = force_slopes(shape.angle + change, which, np.maximum(x[:n_edges], _SMALL))
        offset = -slope @ change
        if attempt in (2, 4) and not has_errors:
            parts = _parts(matrix, slope, shape, which, mean, regions)
            errors, evidence = _chosen(
                matrix @ expected + offset, parts, shape, errors, prior, _STEPS[attempt // 4]
            )
        spread = errors.noise**2 * shape.covariance
        spread += np.diag(model_deviations(errors, shape, which) ** 2)
        answer = (slope @ spread).T
        factor = np.linalg.cholesky(slope @ answer + shape.unknown)
        precision = _prior_precision(errors, shape, regions, n_cells)
        white = solve_triangular(factor, np.column_stack([matrix, offset]), lower=True)
        before, (x, covariance) = x, _least_squares(white, precision, expected, mean, n_edges)
        residual = white @ np.append(x, 1.0)
        change = -answer @ solve_triangular(factor, residual, lower=True, trans=1)
        change *= min(1.0, _REACH / max(float(np.max(np.abs(change))), 1e-300))
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
    direction, arc = _diagonals(shape, which)
    return np.sqrt(errors.junction**2 * direction + (HIDDEN * errors.arc) ** 2 * arc)


def _diagonals(
    shape: Observability, which: Equations
) -> tuple[Float[np.ndarray, " angles"], Float[np.ndarray, " angles"]]:
    """Variances of the angles for errors of directions and of arcs of size 1."""
    direction = np.arange(len(shape.angle)) < which.n_directions
    arc = np.zeros(len(shape.angle))
    arc[which.n_directions :] = np.maximum(shape.length, _SHORTEST)[: which.n_arcs] ** 2
    return direction * 1.0, arc


def _chosen(
    residual: Float[np.ndarray, " rows"],
    parts: Errors,
    shape: Observability,
    errors: Errors,
    prior: float | None,
    steps: int,
) -> tuple[Errors, float]:
    """Errors and widths of the priors of the largest evidence, and its logarithm."""
    bounds = shape.bounds
    if "arc" in bounds:
        # With wide priors, this is restricted maximum likelihood: the errors do not depend on how well the
        # prior describes the tensions.
        wide = errors._replace(tension=prior or 1.0, region=0.0 if prior else 1.0, pressure=10.0)
        free = {name: bounds[name] for name in ("junction", "arc", "noise")}
        first, _ = most_evident(residual, parts, shape.unknown, wide, free, steps=steps)
        errors = errors._replace(junction=first.junction, arc=first.arc, noise=first.noise)
        bounds = {name: bounds[name] for name in bounds if name not in free}
    return most_evident(residual, parts, shape.unknown, errors, bounds, steps=steps)


def _parts(
    matrix: Float[np.ndarray, "rows unknowns"],
    slope: csr_array,
    shape: Observability,
    which: Equations,
    mean: Float[np.ndarray, " unknowns"],
    regions: Float[np.ndarray, "edges edges"],
) -> Errors:
    """Covariances of the forces for each standard deviation of 1."""
    direction, arc = ((slope * d @ slope.T).toarray() for d in _diagonals(shape, which))
    n_edges = len(shape.loose)
    pull, push = matrix[:, :n_edges], matrix[:, n_edges:] / shape.size
    # The mean tension is 1.
    centred = pull - np.outer(pull @ np.ones(n_edges), mean[:n_edges])
    return Errors(
        junction=direction,
        arc=arc,
        noise=slope @ (slope @ shape.covariance).T,
        tension=centred @ centred.T,
        region=centred @ regions @ centred.T,
        pressure=push @ push.T,
    )


def _regions(which: Equations) -> Float[np.ndarray, "edges edges"]:
    """Covariance of tensions that are similar in regions, of mean variance 1."""
    n = len(which.edges)
    meet = np.zeros((n, n))
    for k in range(3):
        np.add.at(meet, (which.half_edge[:, k], which.half_edge[:, k - 1]), -1.0)
    meet += meet.T
    root = np.linalg.inv(meet + np.diag(_KAPPA - meet.sum(axis=1)))
    covariance = root @ root
    return covariance * n / np.trace(covariance)


def _prior_precision(
    errors: Errors, shape: Observability, regions: Float[np.ndarray, "edges edges"], n_cells: int
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Inverse covariance of tensions and pressures in the prior."""
    n = len(regions)
    precision = np.diag(np.full(n + n_cells, (shape.size / errors.pressure) ** 2))
    tension = errors.tension**2 * np.eye(n) + errors.region**2 * regions
    precision[:n, :n] = np.linalg.inv(tension)
    return precision


def _least_squares(
    white: Float[np.ndarray, "rows columns"],
    precision: Float[np.ndarray, "unknowns unknowns"],
    expected: Float[np.ndarray, " unknowns"],
    mean: Float[np.ndarray, " unknowns"],
    n_edges: int,
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, "unknowns unknowns"]]:
    """Tensions of mean 1 and pressures that minimise the forces; the last column has no unknown."""
    matrix, given = white[:, :-1], white[:, -1]
    normal = matrix.T @ matrix + precision
    heavy = 1e3 * np.trace(normal) / len(normal) * n_edges
    normal += heavy * np.outer(mean, mean)
    right = -matrix.T @ given + precision @ expected + heavy * mean
    root = cho_factor(normal)
    x = cho_solve(root, right)
    if np.any(x[:n_edges] < 0):
        x = _not_negative(normal, right, n_edges)
    return x, cho_solve(root, np.eye(len(x)))


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
