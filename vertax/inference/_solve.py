"""Tensions and pressures in balance, and the angles nearest to those seen."""

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
from vertax.inference._seen import Seen

# From this deviation of its direction on, in radians, an edge says nothing, nor if it is no longer than so
# many times the noise; how large forces may be there.
_LOOSE, _SHORT, _UNKNOWN = 0.2, 8.0, 10.0
# How much pressures may differ, mean tensions over a cell diameter.
_PRESSURE = 10.0
# How many times the spread of tensions their prior is wide; at least and at most.
_TIMES, _WIDTHS, _START = 2.0, (0.3, 3.0), 0.5
# Least tension by which noise is judged.
_SMALL = 0.2
_FIRST = Errors(0.05, 0.5, 1.0)
# How much less or more noise than points tell may be found, logarithms: pixels on a straight line depart from
# it by a pattern that averages out, which what is rough does not.
_LESS, _ROUGH_LESS, _MORE = -2.3, -0.35, 0.7
# From this error on, in radians, arcs say little of tensions.
_ARCS = 0.02
# By how much angles may be adjusted, in radians.
_REACH = 0.5


class Told(NamedTuple):
    """What a shape tells for the balance of forces."""

    angle: Float[np.ndarray, " angles"]
    """Directions at junctions, and angles of arcs."""
    covariance: Float[np.ndarray, "angles angles"]
    """Of the angles, as the noise of points makes it."""
    length: Float[np.ndarray, " edges"]
    """Of chords, in cell diameters."""
    loose: Bool[np.ndarray, " edges"]
    """Edges so short that their direction is not known."""
    unknown: Float[np.ndarray, "rows rows"]
    """Covariance of the forces along these: what an edge pulls at one end it pulls back at the other, so that
    the balance of both ends together is left."""
    size: float
    """Root of the mean area of a cell."""
    least_noise: float
    """That may be found over that of points, a logarithm."""


class Balance(NamedTuple):
    """What balances forces best."""

    tension: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Of tensions and pressures."""
    angle: Float[np.ndarray, " angles"]
    """The angles with which all forces balance."""
    errors: Errors
    """Of the model, which no noise explains, and the noise, as forces tell it, over that of the points."""
    residual: Float[np.ndarray, " rows"]
    """Forces that are left with the angles as they were seen, over their standard deviations."""
    loose: Bool[np.ndarray, " edges"]
    """Edges so short that their direction is not known."""


def told(
    fitted: Seen, curves: Fitted, which: Equations, uncertain: Bool[np.ndarray, " all_edges"]
) -> Told:
    """What a shape tells for the balance of forces.

    `uncertain` marks edges that may be between other cells; they are treated as those without a direction.
    """
    slope = angle_slopes(fitted, which)
    covariance = curves.noise**2 * (slope @ splu(curves.precision).solve(slope.T.toarray()))
    variance = np.zeros(len(which.edges))
    np.maximum.at(variance, which.half_edge.ravel(), np.diag(covariance)[: which.n_directions])
    loose = (variance > _LOOSE**2) | (which.chord < _SHORT * curves.noise)
    loose |= uncertain[which.edges]
    unknown = pulls(fitted, which, loose)
    return Told(
        angle=angles(fitted, which),
        covariance=covariance,
        length=np.maximum(which.chord / fitted.size, 0.05),
        loose=loose,
        unknown=_UNKNOWN**2 * unknown @ unknown.T,
        size=fitted.size,
        least_noise=_LESS if curves.crisp else _ROUGH_LESS,
    )


# What was seen are angles a with the covariance C, from the noise of points. Where the tissue is not in
# balance, angles differ from those of a balance as well, and count as a part of a with the covariance τ².
# Forces r(x, a) = A(a) x are linear in the unknowns x. To first order their covariance is S = J C Jᵀ with
# J = ∂r/∂a. Weighted least squares with fixed a would shrink what is noisy, because noise of A and of r is
# the same noise. So a is adjusted as well (total least squares: Britt & Luecke 1973,
# doi:10.1080/00401706.1973.10489060): linearised at (x, a),
#
#     x' minimises (A x' - J d)ᵀ S⁻¹ (A x' - J d) + prior,      d' = - C Jᵀ S⁻¹ (A x' - J d),
#
# where d = a - a_seen. At its end all forces balance with the adjusted angles.
def solve(
    shape: Told,
    which: Equations,
    *,
    exact: bool,
    prior: float | None,
    errors: Errors | None = None,
    rounds: int = 8,
) -> Balance:
    """Tensions and pressures in balance.

    **Arguments:**

    - `shape`: what was seen.
    - `which`: the balances that count.
    - `exact`: whether there cannot be more noise than points tell.
    - `prior`: standard deviation of tensions about 1; left out, some times that of those which are known.
    - `errors`: of model and noise; left out, as large as forces tell.
    - `rounds`: of adjusting the angles.

    **Returns:** the [`Balance`][vertax.inference._solve.Balance].
    """
    n_edges, n_cells, loose = len(which.edges), len(which.cells), shape.loose
    x = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    change = np.zeros(len(shape.angle))
    # Before anything was seen: tensions about 1, and pressures of that order in a cell.
    expected = x.copy()
    width = prior or _START
    mean = np.append(~loose, np.zeros(n_cells, bool)) / max(1, np.sum(~loose))
    at_junctions, along = np.zeros_like(change), np.zeros_like(change)
    at_junctions[: which.n_directions] = 1.0
    along[which.n_directions :] = shape.length**2
    known, shares = errors is not None, (shape.least_noise, 0.0 if exact else _MORE)
    errors = _FIRST if errors is None else errors
    covariance = residual = np.zeros(0)
    for attempt in range(rounds):
        matrix = forces(shape.angle + change, which, loose)
        slope = force_slopes(shape.angle + change, which, np.maximum(x[:n_edges], _SMALL))
        offset = -slope @ change
        if attempt in (2, 4) and not known:
            parts = Errors(
                (slope * at_junctions @ slope.T).toarray(),
                (slope * along @ slope.T).toarray(),
                slope @ (slope @ shape.covariance).T,
            )
            basis = np.linalg.svd(mean[None])[2][1:].T
            left_over = matrix @ expected + offset
            errors = model_errors(matrix @ basis, left_over, parts, shape.unknown, errors, shares)
        # Where arcs are not in balance, that is not chance: friction holds weak edges and strong ones in
        # another way, which would bias tensions long before it shows. So they have less to say.
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
        # Before angles are adjusted by much: where noise is large, tensions could drift with the prior.
        if prior is None and attempt < 2:
            width = _varied(x[:n_edges][~loose], np.diag(covariance)[:n_edges][~loose])
        if attempt > (1 if known else 4) and np.max(np.abs(x - before)[:n_edges]) < 1e-3:
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
    """How much tensions may differ: some times as much as those do that are known, because they may be alike
    over many cells, and the prior takes each by itself."""
    weight = 1 / (variance + 0.05)
    spread = np.sum(weight * ((tension - 1) ** 2 - variance)) / max(np.sum(weight), 1e-300)
    return float(np.clip(_TIMES * np.sqrt(max(spread, 0.0)), *_WIDTHS))


def _not_negative(
    normal: Float[np.ndarray, "n n"], right: Float[np.ndarray, " n"], n: int
) -> Float[np.ndarray, " n"]:
    """The solution of normal equations whose first `n` entries are not negative."""
    # Without the others, which follow.
    other = cho_factor(normal[n:, n:])
    through = cho_solve(other, np.column_stack([normal[n:, :n], right[n:]]))
    reduced = normal[:n, :n] - normal[:n, n:] @ through[:, :-1]
    root = np.linalg.cholesky(0.5 * (reduced + reduced.T))
    goal = solve_triangular(root, right[:n] - normal[:n, n:] @ through[:, -1], lower=True)
    first = nnls(root.T, goal, maxiter=50 * n)[0]
    return np.concatenate([first, through[:, -1] - through[:, :-1] @ first])
