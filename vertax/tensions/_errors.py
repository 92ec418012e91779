"""Sizes of the errors of noise and model, and widths of the priors, chosen by the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.optimize import minimize


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
# 1, and U is that of unknown forces. Derivative: 2 s_k² [tr(K⁻¹ V_k) - rᵀ K⁻¹ V_k K⁻¹ r] for ln s_k. Parts of a
# large tissue count as independent.
def most_evident(
    patches: list[Patch], guess: Errors, bounds: dict[str, tuple[float, float]], *, steps: int
) -> tuple[Errors, float]:
    """The standard deviations of the largest marginal likelihood (evidence), and its logarithm.

    **Arguments:**

    - `patches`: residual forces and their covariances.
    - `guess`: initial standard deviations.
    - `bounds`: smallest and largest standard deviation by name; others keep the guess.
    - `steps`: largest number of iterations (L-BFGS-B).

    **Returns:** the [`Errors`][vertax.tensions._errors.Errors] and the evidence.
    """
    free = [k for k, name in enumerate(Errors._fields) if name in bounds]
    noise = Errors._fields.index("noise")
    held = [k for k in range(len(guess)) if k not in free and guess[k]]
    constants = [
        patch.unknown + sum((guess[k] ** 2 * patch.parts[k] for k in held), 0.0) for patch in patches
    ]

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        ratio = np.exp(2 * logs)
        value, slope = 0.0, np.zeros(len(free))
        for patch, constant in zip(patches, constants, strict=True):
            total = constant + sum(s * patch.parts[k] for s, k in zip(ratio, free, strict=True))
            root, failed = dpotrf(total.T, lower=True, overwrite_a=True, clean=True)
            if failed:
                raise np.linalg.LinAlgError("The covariance of the forces is not positive definite.")
            value += 2 * float(np.sum(np.log(np.diag(root))))
            inverse = dpotri(root, lower=True, overwrite_c=True)[0]
            # Below the diagonal twice, in place of above it.
            inverse *= 2
            np.fill_diagonal(inverse, 0.5 * np.diag(inverse))
            force = 0.5 * (inverse @ patch.residual + patch.residual @ inverse)
            value += float(patch.residual @ force)
            for number, (s, k) in enumerate(zip(ratio, free, strict=True)):
                part = patch.parts[k]
                slope[number] += 2 * s * (np.vdot(inverse.T, part) - force @ part @ force)
        if noise in free:
            at = free.index(noise)
            value += logs[at] ** 2
            slope[at] += 2 * logs[at]
        return value, slope

    if not free:
        return guess, -0.5 * loss(np.zeros(0))[0]
    limits = np.log([bounds[Errors._fields[k]] for k in free]).reshape(-1, 2)
    values = [float(value) for value in guess]
    first = np.clip(np.log([values[k] for k in free]), *limits.T)
    options = {"maxiter": steps, "ftol": 1e-6, "gtol": 0.1}
    optimum = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=limits, options=options)
    for k, log in zip(free, optimum.x, strict=True):
        values[k] = float(np.exp(log))
    return Errors(*values), -0.5 * float(optimum.fun)
