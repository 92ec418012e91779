"""Deviations by turning noise over: what Laplace's approximation is checked against."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from vertax.inference._balance import Equations, angle_slopes
from vertax.inference._curves import Fitted, Points
from vertax.inference._outcome import relative
from vertax.inference._seen import Seen
from vertax.inference._solve import Balance, Told, solve


# The angles with which all forces balance, with the tensions found, are taken for the truth. To them comes
# what the distances of points from curves do, as they were seen, but each stretch along which they are alike
# with a sign by chance (wild bootstrap: Wu 1986, doi:10.1214/aos/1176350142); and errors of the model by
# chance.
def resampled_deviations(
    fitted: Seen,
    curves: Fitted,
    points: Points,
    which: Equations,
    shape: Told,
    balance: Balance,
    *,
    prior: float | None,
    times: int,
    seed: int,
) -> Float[np.ndarray, " tensions"]:
    """Standard deviations of tensions, from shapes with other noise.

    **Arguments:**

    - `fitted`, `curves`, `points`, `which`, `shape`: what was seen.
    - `balance`: what was found.
    - `prior`: of tensions.
    - `times`: number of shapes.
    - `seed`: of their chance.

    **Returns:** the standard deviations.
    """
    random = np.random.default_rng(seed)
    stretch = _stretches(points, 2 * curves.apart)
    # What the distance of each stretch does to the angles.
    by_point = angle_slopes(fitted, which) @ splu(curves.precision).solve(
        (curves.weighted * curves.rest).toarray()
    )
    by_stretch = np.add.reduceat(by_point, np.flatnonzero(np.diff(stretch, prepend=-1)), axis=1)
    errors = balance.errors
    model = np.concatenate(
        [np.full(which.n_directions, errors.junction), errors.arc * shape.length]
    )
    found = []
    for _ in range(times):
        sign = random.choice([-1.0, 1.0], size=by_stretch.shape[1])
        chance = by_stretch @ sign + model * random.normal(size=len(model))
        again = shape._replace(angle=balance.angle + chance)
        found.append(
            relative(solve(again, which, exact=True, prior=prior, errors=errors), which).tension
        )
    return np.std(found, axis=0, ddof=1)


def _stretches(points: Points, length: float) -> Int[np.ndarray, " points"]:
    """Numbers of stretches of edges that are so long, in order."""
    same = np.append(False, points.edge[1:] == points.edge[:-1])
    spacing = np.linalg.norm(np.diff(points.away, axis=0, prepend=points.away[:1]), axis=1)
    course = np.cumsum(np.where(same, spacing, 0.0))
    first = np.flatnonzero(~same)
    begin = np.repeat(course[first], np.diff(np.append(first, len(course))))
    number = np.floor((course - begin) / length).astype(int)
    return np.cumsum(~same | (number != np.append(0, number[:-1]))) - 1
