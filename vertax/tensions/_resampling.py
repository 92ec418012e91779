"""Standard deviations by resampling (wild bootstrap), a check of Laplace's approximation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from vertax._base.sparse_normal import factorised
from vertax.tensions._balance import angle_slopes
from vertax.tensions._curves import Fitted, Points
from vertax.tensions._observed_geometry import ObservedGeometry
from vertax.tensions._outcome import relative
from vertax.tensions._solve import HIDDEN, Balance, System, solve


# The truth of the bootstrap are the angles with which all forces balance at the inferred tensions. Added are
# the effect of the observed distances of points from curves, where each stretch of correlated distances gets
# a random sign (wild bootstrap: Wu 1986, doi:10.1214/aos/1176350142), and random errors of the model.
def resampled_deviations(
    fitted: ObservedGeometry,
    curves: Fitted,
    points: Points,
    system: System,
    balance: Balance,
    *,
    times: int,
    seed: int,
) -> Float[np.ndarray, " tensions"]:
    """Standard deviations of tensions inferred from resampled shapes.

    **Arguments:**

    - `fitted`, `curves`, `points`, `system`: the observed geometry and its equations.
    - `balance`: the inferred tensions and pressures.
    - `times`: number of resampled shapes.
    - `seed`: seed of the random numbers.

    **Returns:** the standard deviations.
    """
    random = np.random.default_rng(seed)
    stretch = _stretches(points, 2 * curves.apart)
    slopes, factor = angle_slopes(fitted, system.which), factorised(curves.precision)
    errors, shape = balance.errors, system.shape
    model = shape.model_deviations(errors._replace(arc=HIDDEN * errors.arc))
    samples = []
    for _ in range(times):
        sign = random.choice([-1.0, 1.0], size=stretch.max(initial=-1) + 1)
        # Effect of the distances of each stretch on the angles.
        moved = factor.solve(curves.weighted @ (curves.rest * sign[stretch]))
        chance = slopes @ moved + model * random.normal(size=len(model))
        again = System(
            shape._replace(angle=balance.angle + chance), system.which, regional=system.regional
        )
        samples.append(relative(solve(again, errors), system.which).tension)
    return np.std(samples, axis=0, ddof=1)


def _stretches(points: Points, length: float) -> Int[np.ndarray, " points"]:
    """Index of the stretch of given length of each point, in order along the edges."""
    same = np.append(False, points.edge[1:] == points.edge[:-1])
    spacing = np.linalg.norm(np.diff(points.away, axis=0, prepend=points.away[:1]), axis=1)
    course = np.cumsum(np.where(same, spacing, 0.0))
    first = np.flatnonzero(~same)
    begin = np.repeat(course[first], np.diff(np.append(first, len(course))))
    number = np.floor((course - begin) / length).astype(int)
    return np.cumsum(~same | (number != np.append(0, number[:-1]))) - 1
