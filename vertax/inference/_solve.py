"""Tensions and pressures in balance, and the geometry that is nearest to what was seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize, nnls
from scipy.sparse.linalg import SuperLU, splu

from vertax.inference._balance import Equations, Slopes, Turns, forces, slopes
from vertax.inference._seen import Fitted, Seen

# From this deviation of its direction on, in radians, an edge says nothing; how large forces may be there.
_LOOSE, _UNKNOWN = 0.2, 10.0
# How much pressures may differ, mean tensions over a cell diameter; and tensions, at least and at most.
_PRESSURE, _WIDTHS = 10.0, (0.2, 3.0)
# Least tension by which noise is judged.
_SMALL = 0.4
_WEAK = 0.2
ABS = True
_FIRST = (0.05, 0.5, 1.0)
# How much less or more noise than pixels tell may be found, logarithms: pixels on a straight line depart from
# it by a pattern that averages out.
_SHARES = (-2.3, 0.7)
# No tissue is a foam better than that: half a degree, and an arc of 1 per cent of a cell.
_LEAST = (0.005, 0.02)


class Balance(NamedTuple):
    """What balances forces best."""

    tension: Float[np.ndarray, " edges"]
    pressure: Float[np.ndarray, " cells"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Of tensions and pressures."""
    change: Float[np.ndarray, " geometry"]
    """Of the geometry, from what was seen to what is in balance."""
    model_errors: tuple[float, float]
    """Standard deviations of angles at junctions, and of the angles of arcs of the length of a cell, that no
    noise explains."""
    noise: float
    """Standard deviation of a point of an edge, as forces tell it."""
    residual: Float[np.ndarray, " rows"]
    """Forces that are left where the geometry is as it was seen, over their standard deviations."""
    loose: Bool[np.ndarray, " edges"]
    """Edges so short that their direction is not known."""


# What was seen is a geometry g with the covariance C; where the tissue is not in balance, angles differ from
# those of a balance as well, and count as a part of g with the covariance τ². Forces r(x, g) = A(g) x are
# linear in the unknowns x. To first order their covariance is S = J C Jᵀ with J = ∂r/∂g. Weighted least
# squares with fixed g would shrink what is noisy, because noise of A and of r is the same noise. So g is
# adjusted as well (total least squares: Britt & Luecke 1973, doi:10.1080/00401706.1973.10489060):
# linearised at (x, g),
#
#     x' minimises (A x' - J d)ᵀ S⁻¹ (A x' - J d) + prior,      d' = - C Jᵀ S⁻¹ (A x' - J d),
#
# where d = g - g_seen. At its end all forces balance in the adjusted geometry.
def solve(
    fitted: Seen,
    arcs: Fitted,
    which: Equations,
    *,
    noise: float,
    exact: bool,
    prior: float | None,
    rounds: int = 8,
) -> Balance:
    """Tensions and pressures in balance.

    **Arguments:**

    - `fitted`, `arcs`: the geometry, and how well it is known.
    - `which`: the balances that count.
    - `noise`: standard deviation of a point of an edge.
    - `exact`: whether there cannot be more noise than that.
    - `prior`: of tensions about 1; left out, from how much they differ.
    - `rounds`: of adjusting the geometry.

    **Returns:** the [`Balance`][vertax.inference._solve.Balance].
    """
    n_edges, n_cells = len(which.edges), len(which.cells)
    sides = which.cell_place[fitted.cells[which.edges]]
    x = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    change = np.zeros(len(arcs.change))
    turns = Turns(np.zeros((len(which.junctions), 3)), np.zeros(n_edges))
    inverse = splu(arcs.precision)
    # Before anything was seen: tensions about 1, and pressures of that order in a cell.
    width = 1.0 if prior is None else prior
    expected = np.concatenate([np.ones(n_edges), np.zeros(n_cells)])
    length = np.linalg.norm(fitted.chord[which.edges], axis=1) / fitted.size
    length = np.maximum(length, 0.05)
    # The direction of a short edge may be all noise. What it pulls at one end it pulls back at the other: an
    # unknown force there leaves the balance of both ends together.
    loose = _direction_deviations(fitted, which, inverse, noise) > _LOOSE
    loose |= length * fitted.size < 8 * noise
    unknown = _pulls(fitted, which, loose)
    unknown = _UNKNOWN**2 * unknown @ unknown.T
    mean = np.append(~loose, np.zeros(n_cells, bool)) / max(1, np.sum(~loose))
    basis = np.linalg.svd(mean[None])[2][1:].T
    known, shares = _FIRST, (_SHARES[0], 0.0 if exact else _SHARES[1])
    covariance = residual = np.zeros(0)
    for attempt in range(rounds):
        here = fitted.moved(change)
        tension, pressure = np.maximum(x[:n_edges], _SMALL), x[n_edges:]
        step = pressure[sides[:, 0]] - pressure[sides[:, 1]]
        matrix = forces(here, which, turns)
        matrix[: 2 * len(which.junctions), :n_edges][:, loose] = 0
        slope = slopes(here, which, turns, tension, step)
        answer = noise**2 * inverse.solve(slope.geometry.T.toarray())
        offset = -slope.geometry @ change - _turning(slope, turns)
        seen = slope.geometry @ answer
        soft = np.maximum(x[:n_edges], _WEAK) if ABS else np.ones(n_edges)
        soft_j = soft[which.edge_place[fitted.half_edge[which.junctions]]]
        model = _model(slope, length, soft, soft_j)
        if attempt in (2, 4):
            known = model_errors(
                matrix @ basis, matrix @ expected + offset, seen, unknown, model, known, shares
            )
        answer = known[2] ** 2 * answer
        spread = (
            known[2] ** 2 * seen + unknown + known[0] ** 2 * model[0] + known[1] ** 2 * model[1]
        )
        factor = np.linalg.cholesky(spread)
        white = solve_triangular(factor, np.column_stack([matrix, offset]), lower=True)
        white, given = white[:, :-1], white[:, -1]
        deviation = np.append(np.full(n_edges, width), np.full(n_cells, _PRESSURE / fitted.size))
        normal = white.T @ white + np.diag(deviation**-2.0)
        heavy = 1e3 * np.trace(normal) / len(normal) * n_edges
        normal += heavy * np.outer(mean, mean)
        right = -white.T @ given + expected / deviation**2 + heavy * mean
        root = np.linalg.cholesky(normal).T
        x = cho_solve((root, False), right)
        if np.any(x[:n_edges] < 0):
            x = _not_negative(normal, right, n_edges)
        left = matrix @ x + offset
        pull = cho_solve((factor, True), left)
        change = -answer @ pull
        by_junction = pull[: 2 * len(which.junctions)].reshape(-1, 1, 2)
        turns = Turns(
            -(known[0] ** 2) / soft_j**2 * np.sum(slope.junction * by_junction, axis=-1),
            -((known[1] * length / soft) ** 2) * slope.arc * pull[2 * len(which.junctions) :],
        )
        covariance = cho_solve((root, False), np.eye(len(x)))
        residual = solve_triangular(factor, left, lower=True)
        if prior is None:
            width = _varied(x[:n_edges][~loose], np.diag(covariance)[:n_edges][~loose], width)
    return Balance(
        x[:n_edges], x[n_edges:], covariance, change, known[:2], noise * known[2], residual, loose
    )


def _direction_deviations(
    seen: Seen, which: Equations, inverse: SuperLU, noise: float
) -> Float[np.ndarray, " edges"]:
    """Standard deviation of the direction of the tangents of each edge, the larger of both."""
    n = len(which.edges)
    chord = seen.chord[which.edges]
    across = np.stack([-chord[:, 1], chord[:, 0]], axis=1) / np.sum(chord**2, axis=1)[:, None]
    starts, ends = 2 * seen.ends[which.edges].T
    angle = 2 * seen.n_vertices + which.edges
    edge = np.arange(n)
    found = []
    for sign in (-1.0, 1.0):
        turn = np.zeros((seen.n_geometry, n))
        for axis in range(2):
            turn[starts + axis, edge] -= across[:, axis]
            turn[ends + axis, edge] += across[:, axis]
        turn[angle, edge] = sign
        turn[angle + len(seen.angle) + which.edges, edge] = 1.0
        turn[angle + len(seen.angle) + which.edges + 1, edge] = -sign
        found.append(np.sum(turn * inverse.solve(turn), axis=0))
    return noise * np.sqrt(np.max(found, axis=0))


def _pulls(
    seen: Seen, which: Equations, chosen: Bool[np.ndarray, " edges"]
) -> Float[np.ndarray, "rows forces"]:
    """How the forces along some edges enter the equations, two components each."""
    edges = np.flatnonzero(chosen)
    matrix = np.zeros((which.n_rows, len(edges), 2))
    place = np.full(seen.n_vertices, -1)
    place[which.junctions] = np.arange(len(which.junctions))
    for end, sign in ((0, 1.0), (1, -1.0)):
        at = place[seen.ends[which.edges[edges], end]]
        here = np.flatnonzero(at >= 0)
        for axis in range(2):
            matrix[2 * at[here] + axis, here, axis] = sign
    return matrix.reshape(which.n_rows, -1)


def _varied(
    tension: Float[np.ndarray, " edges"], variance: Float[np.ndarray, " edges"], width: float
) -> float:
    """How much tensions may differ, by how much those do that are known (MacKay 1992,
    doi:10.1162/neco.1992.4.3.415); and half as much again, because they may be alike over many cells, and the
    prior takes each by itself."""
    known = float(np.sum(np.clip(1 - variance / width**2, 0.0, 1.0)))
    if known < 3:
        return _WIDTHS[0]
    return float(np.clip(1.5 * np.sqrt(np.sum((tension - 1) ** 2) / known), *_WIDTHS))


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


def _turning(slope: Slopes, turns: Turns) -> Float[np.ndarray, " rows"]:
    at_junctions = np.sum(slope.junction * turns.junction[..., None], axis=1)
    return np.concatenate([at_junctions.ravel(), slope.arc * turns.arc])


def _model(
    slope: Slopes, length: Float[np.ndarray, " edges"], soft, soft_j
) -> tuple[Float[np.ndarray, "rows rows"], Float[np.ndarray, "rows rows"]]:
    """Covariances of forces for errors of the model of 1."""
    n_junctions, n = len(slope.junction), 2 * len(slope.junction) + len(length)
    at_junctions, along = np.zeros((n, n)), np.zeros((n, n))
    block = np.einsum("jha,jhb,jh->jab", slope.junction, slope.junction, soft_j**-2.0)
    row = 2 * np.arange(n_junctions)
    for a in range(2):
        for b in range(2):
            at_junctions[row + a, row + b] = block[:, a, b]
    row = np.arange(2 * n_junctions, n)
    along[row, row] = (slope.arc * length / soft) ** 2
    return at_junctions, along


def model_errors(
    matrix: Float[np.ndarray, "rows unknowns"],
    given: Float[np.ndarray, " rows"],
    seen: Float[np.ndarray, "rows rows"],
    unknown: Float[np.ndarray, "rows rows"],
    model: tuple[Float[np.ndarray, "rows rows"], Float[np.ndarray, "rows rows"]],
    guess: tuple[float, float, float],
    shares: tuple[float, float],
) -> tuple[float, float, float]:
    """Errors of the model, and the true noise over that of the pixels, by restricted maximum likelihood.

    Combinations of the equations in which no unknown is left, N, have the covariance Nᵀ S N.
    """
    left, values, _ = np.linalg.svd(matrix)
    free = left[:, int(np.sum(values > 1e-9 * values[0])) :]
    z = free.T @ given
    noise, loose, junction, arc = (free.T @ part @ free for part in (seen, unknown, *model))

    def loss(logs: np.ndarray) -> float:
        ratio = np.exp(2 * logs)
        total = ratio[2] * noise + loose + ratio[0] * junction + ratio[1] * arc
        factor = np.linalg.cholesky(total)
        left = solve_triangular(factor, z, lower=True)
        return left @ left + 2 * np.sum(np.log(np.diag(factor))) + logs[2] ** 2

    bounds = [(np.log(least), np.log(1.5)) for least in _LEAST] + [shares]
    found = minimize(
        loss,
        np.log(np.array(guess)),
        method="Nelder-Mead",
        bounds=bounds,
        options={"xatol": 0.05, "fatol": 0.02},
    ).x
    return float(np.exp(found[0])), float(np.exp(found[1])), float(np.exp(found[2]))
