"""What a movie does not determine: names and warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse.csgraph import connected_components

from vertax.energies import AbstractEnergy
from vertax.inference._movie_equations import Solution, least_share, scaled_inverse
from vertax.mesh import Free, Tissue


def warn_of_straight_outlines(frames: Tissue, outline: bool) -> None:
    """Warn if outer cells are used but have straight outer sides, as tables of corners have."""
    angles = eqx.filter_vmap(lambda tissue: tissue.angles)(frames)
    straight = angles is None or not jnp.any(jnp.abs(angles) > 1e-6)
    if outline and straight and isinstance(frames.boundary, Free):
        warnings.warn(
            "All sides on the outline are straight, so the pressure of outer cells is unknown. Include "
            "points along these sides in the table, or pass `outline=False`.",
            stacklevel=3,
        )


def names_of(parameters: AbstractEnergy) -> list[str]:
    """The name of each entry of each parameter, in the order of the fit."""
    names = []
    for path, array in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = jax.tree_util.keystr(path).lstrip(".")
        entries = [f"[{', '.join(map(str, index))}]" for index in np.ndindex(array.shape)]
        names += [name + (entry if array.ndim else "") for entry in entries]
    return names


def undetermined_in(names: list[str], solution: Solution) -> tuple[str, ...]:
    """Names of what the movie does not determine; a warning for that, and for what it hardly determines."""
    free: dict[str, None] = {}
    weak: dict[str, float] = {}
    for slopes, scales, theta, covariance in zip(
        *map(np.asarray, (solution.slopes, solution.scales, solution.theta, solution.covariance)),
        strict=True,
    ):
        size = np.sqrt(np.where(scales > 0, scales, 1))
        inverse, _ = scaled_inverse(jnp.asarray(slopes), jnp.asarray(scales))
        # The projection on directions in which the scaled information is 0.
        null = np.eye(len(theta)) - (np.asarray(inverse) @ slopes) * size[1][:, None] / size[1]
        least = least_share(slopes.dtype)
        group = connected_components(np.abs(null) > least, directed=False)[1]
        for k in np.unique(group[np.diag(null) > least]):
            free["+".join(names[i] for i in np.flatnonzero(group == k))] = None
        # Eigenvectors of the covariance of relative errors.
        fixed = np.flatnonzero(np.isfinite(np.diag(covariance)) & (theta != 0))
        relative = covariance[np.ix_(fixed, fixed)] / theta[fixed] / theta[fixed, None]
        variance, vectors = np.linalg.eigh(relative)
        for value, vector in zip(variance, vectors.T, strict=True):
            if value > _LARGEST_ERROR**2:
                parts = fixed[np.abs(vector) > 0.3]
                weak["+".join(names[i] for i in parts)] = float(np.sqrt(value))
    if free:
        warnings.warn(
            f"The movie does not determine {_list(free)} (`undetermined`): these have infinite standard "
            "errors, and depend on the guess. Give a known value as a number instead of an array, or use "
            "more of the tissue.",
            stacklevel=3,
        )
    if weak:
        warnings.warn(
            "The movie hardly determines these parameters together: "
            f"{_list({f'{name} (relative error {error:.2g})': 0 for name, error in weak.items()})}. Give a "
            "known value as a number instead of an array, or more frames in shorter intervals.",
            stacklevel=3,
        )
    if np.isnan(solution.covariance).any():
        warnings.warn(
            f"Standard errors are NaN: they require more steps than parameters, {len(names)}.",
            stacklevel=3,
        )
    return tuple(free)


def _list(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


_LARGEST_ERROR = 0.5
"""Standard error of a combination of parameters, relative to them, that is hardly determined."""


def warn_of_long_intervals(
    theta: Float[Array, "windows parameters"],
    change: Float[Array, "windows parameters"],
    deviations: Float[Array, "windows parameters"],
) -> None:
    """Warn if a parameter changes by more than 3 standard errors and 5 % with the other implicitness."""
    large = jnp.abs(change) > jnp.maximum(3 * deviations, 0.05 * jnp.abs(theta))
    if jnp.any(large):
        ratio = jnp.max(jnp.where(deviations > 0, jnp.abs(change) / deviations, 0))
        warnings.warn(
            "Frames are too far apart: with the other `implicitness` parameters change by up to "
            f"{float(ratio):.2g} standard errors (`interval_error`). Take frames in shorter "
            "intervals, or only those after fast changes.",
            stacklevel=3,
        )
