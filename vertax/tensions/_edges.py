"""Solutions with arcs and with straight edges, and the choice between them by the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.sparse import csc_array, diags_array

from vertax.tensions._balance import Equations, equations
from vertax.tensions._curves import Fitted, Points, read_courses
from vertax.tensions._observed_geometry import ObservedGeometry
from vertax.tensions._solve import Balance, Observability, observability, solve


class Solution(NamedTuple):
    """A balance of forces in a fitted geometry."""

    fitted: ObservedGeometry
    which: Equations
    shape: Observability
    balance: Balance


def vertices_only(geometry: ObservedGeometry, noise: float) -> Fitted:
    """The vertices as they are, with independent noise, of straight edges without points."""
    n = geometry.n_geometry
    precision = np.where(np.arange(n) < 2 * geometry.n_vertices, 1.0, 1e12)
    empty = csc_array((n, 0))
    change = np.zeros(n)
    return Fitted(
        change, csc_array(diags_array(precision)), noise, np.zeros(0), empty, 0.0, 0.0, True
    )


def fit(
    geometry: ObservedGeometry,
    points: Points,
    grain: float,
    *,
    apart: float | None,
    noise: float | None,
) -> Fitted:
    """Curves through the points of edges that end at a junction, see `read_courses`; or no fit of vertices
    without points."""
    if not len(points.edge):
        return vertices_only(geometry, grain if noise is None else noise)
    return read_courses(geometry, points, grain, apart=apart, noise=noise)


def solution(
    geometry: ObservedGeometry,
    curves: Fitted,
    uncertain: Bool[np.ndarray, " edges"],
    *,
    straight: bool,
    known_noise: bool,
    prior: float | None,
) -> Solution:
    """The balance of forces with arcs or with straight edges.

    **Arguments:**

    - `geometry`, `curves`: the initial geometry and the fit.
    - `uncertain`: contacts that may be between other cells.
    - `straight`: whether edges are straight.
    - `known_noise`: whether the noise is at most that of the points.
    - `prior`: standard deviation of tensions about 1.

    **Returns:** the [`Solution`][vertax.tensions._edges.Solution].
    """
    fitted = geometry.moved(curves.change)
    which = equations(fitted, straight=straight)
    shape = observability(fitted, curves, which, uncertain, prior=prior, known_noise=known_noise)
    return Solution(fitted, which, shape, solve(shape, which, prior=prior))


# Both describe the same angles. With straight edges, the angles of arcs are noise, α ~ N(0, ν² C); with arcs
# they are unknowns of the balance; its forces 2 γ sin α change by 2 for a change of α by 1.
def more_evident(arcs: Solution, straight: Solution) -> Solution:
    """The solution of the larger evidence."""
    n = arcs.which.n_directions
    angle = arcs.shape.angle[n:]
    covariance = arcs.shape.covariance[n:, n:] * straight.balance.errors.noise**2
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(len(angle)))
    white = np.linalg.solve(root, angle)
    density = -0.5 * white @ white - np.sum(np.log(np.diag(root)))
    with_arcs = arcs.balance.evidence + len(angle) * np.log(2)
    return arcs if with_arcs >= straight.balance.evidence + density else straight
