"""Sizes of the errors of noise and model, and widths of the priors, chosen by the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs  # pyright: ignore[reportAttributeAccessIssue]

# The search of the optimum ends at derivatives, or a decrease, below these; largest step of a logarithm.
_SLOPE, _DECREASE, _STEP = 0.1, 1e-3, 1.5


class Errors(NamedTuple):
    """Standard deviations: of the angles beyond noise, of the noise, and of the priors; or their logarithms,
    or the covariances of the forces for each standard deviation of 1."""

    junction: Float[np.ndarray, "*shape"] | float
    """Directions at junctions, radians."""
    arc: Float[np.ndarray, "*shape"] | float
    """Angles of arcs of the length of a cell, radians."""
    noise: Float[np.ndarray, "*shape"] | float
    """Noise relative to that of the points."""
    tension: Float[np.ndarray, "*shape"] | float
    """Prior of tensions about 1, independent of each other."""
    region: Float[np.ndarray, "*shape"] | float
    """Prior of tensions about 1, similar in regions of the tissue."""
    pressure: Float[np.ndarray, "*shape"] | float
    """Prior of pressures about 0, in mean tensions over a cell diameter."""


class Patch(NamedTuple):
    """The residual forces of a tissue, or of a part of a large one, and their covariances."""

    residual: Float[np.ndarray, " rows"]
    """Forces at the prior mean."""
    parts: Errors
    """Covariance for each standard deviation of 1."""
    unknown: Float[np.ndarray, "rows rows"]
    """Covariance of unknown forces."""


# With residual forces r = A x̄ - J d at the prior mean x̄, the evidence is the density of r,
#
#     r ~ N(0, K),   K = U + Σ_k s_k² V_k,   -2 ln p = rᵀ K⁻¹ r + ln det K,
#
# where V_k are the covariances of the forces, for noise, errors of the model and priors of standard deviation
# 1, and U is that of unknown forces. Derivatives for ln s_k are 2 s_k² [tr(K⁻¹ V_k) - rᵀ K⁻¹ V_k K⁻¹ r], and
# the second ones, in the mean of observed and expected ones, 4 s_j² s_k² rᵀ K⁻¹ V_j K⁻¹ V_k K⁻¹ r (average
# information: Gilmour, Thompson & Cullis 1995, doi:10.2307/2533274). Parts of a large tissue count as
# independent.
def most_evident(
    patches: list[Patch],
    guess: Errors,
    bounds: dict[str, tuple[float, float]],
    *,
    steps: int,
    centres: dict[str, float],
) -> tuple[Errors, float]:
    """The standard deviations of the largest marginal likelihood (evidence), and its logarithm.

    **Arguments:**

    - `patches`: residual forces and their covariances.
    - `guess`: initial standard deviations.
    - `bounds`: smallest and largest standard deviation by name; others keep the guess.
    - `steps`: largest number of Newton steps.
    - `centres`: of priors of the logarithms, of standard deviation 1; of others, all values are as likely.

    **Returns:** the [`Errors`][vertax.tensions._errors.Errors] and the evidence.
    """
    free = [k for k, name in enumerate(Errors._fields) if name in bounds]
    centre = np.array([np.log(centres.get(Errors._fields[k], np.nan)) for k in free])
    held = [k for k in range(len(guess)) if k not in free and guess[k]]
    constants = [
        patch.unknown + sum((guess[k] ** 2 * patch.parts[k] for k in held), 0.0)
        for patch in patches
    ]

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        ratio = np.exp(2 * logs)
        value, slope, curvature = 0.0, np.zeros(len(free)), np.zeros(2 * (len(free),))
        for patch, constant in zip(patches, constants, strict=True):
            total = constant + sum(s * patch.parts[k] for s, k in zip(ratio, free, strict=True))
            root, failed = dpotrf(total.T, lower=True, overwrite_a=True)
            if failed:
                return np.inf, slope, curvature
            force = dpotrs(root, patch.residual, lower=True)[0]
            value += float(patch.residual @ force + 2 * np.sum(np.log(np.diag(root))))
            pushed = [2 * s * (patch.parts[k] @ force) for s, k in zip(ratio, free, strict=True)]
            pushed = np.reshape(pushed, (len(free), len(force)))
            curvature += pushed @ dpotrs(root, pushed.T, lower=True)[0]
            inverse = dpotri(root, lower=True, overwrite_c=True)[0]
            # The lower triangle counts twice, in place of the upper one, which is 0.
            diagonal, inverse = np.diag(inverse), inverse.T
            for number, (s, k) in enumerate(zip(ratio, free, strict=True)):
                part = patch.parts[k]
                trace = 2 * np.vdot(inverse, part) - diagonal @ np.diag(part)
                slope[number] += 2 * s * trace - pushed[number] @ force
        away = np.where(np.isnan(centre), 0.0, logs - centre)
        value += float(away @ away)
        slope, curvature = slope + 2 * away, curvature + 2 * np.diag(~np.isnan(centre))
        return value, slope, curvature

    limits = np.log([bounds[Errors._fields[k]] for k in free]).reshape(-1, 2).T
    values = np.array([float(value) for value in guess])
    logs = np.clip(np.log(values[free]), *limits)
    now, slope, curvature = loss(logs)
    damping = 0.01
    for _ in range(steps):
        inside = np.where(slope > 0, logs > limits[0] + 1e-9, logs < limits[1] - 1e-9)
        if not np.any(np.abs(slope[inside]) > _SLOPE):
            break
        # Levenberg–Marquardt within the bounds.
        matrix = curvature[np.ix_(inside, inside)]
        matrix = matrix + np.diag(damping * np.diag(matrix) + 1e-3)
        step = np.zeros(len(free))
        step[inside] = np.clip(np.linalg.solve(matrix, -slope[inside]), -_STEP, _STEP)
        trial = np.clip(logs + step, *limits)
        value, *derivatives = loss(trial)
        if value < now:
            done = now - value < _DECREASE
            logs, now, (slope, curvature), damping = trial, value, derivatives, 0.2 * damping
            if done:
                break
        else:
            damping = 10 * damping + 0.1
    values[free] = np.exp(logs)
    return Errors(*values.tolist()), -0.5 * now
