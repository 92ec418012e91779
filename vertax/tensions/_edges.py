"""Solutions with arcs and with straight edges, and the choice between them by the evidence."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy.sparse import csc_array, diags_array

from vertax.tensions._balance import equations
from vertax.tensions._curves import Fitted
from vertax.tensions._errors import Errors
from vertax.tensions._observability import observability, patches
from vertax.tensions._observed_geometry import ObservedGeometry
from vertax.tensions._solve import Balance, System, choose_errors, solve

# Smallest logarithm of the ratio of the evidences at which edges are straight (very strong: Kass & Raftery
# 1995, doi:10.1080/01621459.1995.10476572). Coarse masks do not distinguish arcs from straight edges.
_DECISIVE = 5.0


def vertices_only(geometry: ObservedGeometry, noise: float) -> Fitted:
    """The vertices as they are, with independent noise, of straight edges without points."""
    n = geometry.n_geometry
    precision = np.where(np.arange(n) < 2 * geometry.n_vertices, 1.0, 1e12)
    empty = np.zeros(0), csc_array((n, 0)), np.zeros(0), np.ones(len(geometry.angle)), 0.0, 0.0
    return Fitted(np.zeros(n), csc_array(diags_array(precision)), noise, *empty, crisp=True)


# Both describe the same angles. With straight edges, the angles of arcs are noise, α ~ N(0, ν² C); with arcs
# they are unknowns of the balance; its forces 2 γ sin α change by 2 for a change of α by 1.
def solution(
    geometry: ObservedGeometry,
    curves: Fitted,
    uncertain: Bool[np.ndarray, " edges"],
    *,
    straight: bool | None,
    known_noise: bool,
    prior: float | None,
) -> tuple[System, Balance]:
    """The balance of forces with arcs or with straight edges.

    Errors of the model, widths of the priors, and the choice between arcs and straight edges are those of
    the larger evidence in the whole tissue, or in a few parts of a large one.

    **Arguments:**

    - `geometry`, `curves`: the initial geometry and the fit.
    - `uncertain`: contacts that may be between other cells.
    - `straight`: whether edges are straight; None: by the evidence.
    - `known_noise`: whether the noise is at most that of the points.
    - `prior`: standard deviation of tensions about 1.

    **Returns:** the sum of squares and its solution.
    """
    fitted = geometry.moved(curves.change)

    def system(part: ObservedGeometry, *, flat: bool) -> System:
        which = equations(part, straight=flat)
        options = {"prior": prior, "known_noise": known_noise}
        shape = observability(part, curves, which, uncertain, **options)
        return System(shape, which, regional=prior is None)

    parts = patches(fitted, equations(fitted))
    best: tuple[float, Errors, bool, list[System]] | None = None
    arcs: list[System] = []
    for flat in (False, True) if straight is None else (straight,):
        systems = [system(part, flat=flat) for part in parts]
        errors, evidence = choose_errors(systems, prior)
        for each in arcs:
            evidence += _density_of_arcs(each, float(errors.noise))
        if not flat:
            arcs, evidence = systems, evidence + sum(s.which.n_arcs for s in systems) * np.log(2)
        if best is None or evidence > best[0] + _DECISIVE:
            best = evidence, errors, flat, systems
    assert best is not None
    _, errors, flat, systems = best
    tissue = systems[0] if len(parts) == 1 else system(fitted, flat=flat)
    return tissue, solve(tissue, errors)


def _density_of_arcs(arcs: System, noise: float) -> float:
    """Logarithm of the density of the angles of arcs if they are noise."""
    n = arcs.which.n_directions
    covariance = arcs.covariance[n:, n:] * noise**2
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(len(covariance)))
    white = np.linalg.solve(root, arcs.shape.angle[n:])
    return float(-0.5 * white @ white - np.sum(np.log(np.diag(root))))
