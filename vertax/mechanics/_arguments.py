"""Checks of the arguments of this package: each error names the argument and the remedy."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, describe
from vertax._base.model_checks import check_energy, check_planar, warn_of_columns
from vertax._base.tracing import is_concrete
from vertax.dissipations import AbstractDissipation
from vertax.mesh import Periodic, Tissue
from vertax.relax import Relaxation


def check_system(tissue: Any, energy: Any, *, box: str | None = None) -> None:
    """Raise an error unless the arguments are one tissue and an energy.

    **Arguments:**

    - `tissue`, `energy`: the objects to check.
    - `box`: name of the calculation, for the message, if it needs a periodic box.

    **Raises:**

    - `TypeError` for objects of other classes.
    - `ValueError` for a batch of tissues, or for a free tissue or one on a surface if `box` is given.
    """
    check_tissue(tissue, box=box)
    check_energy(energy)
    warn_of_columns(energy, tissue)


def check_tissue(tissue: Any, *, box: str | None = None) -> None:
    """Raise an error unless the argument is one tissue; see `check_system`."""
    if not isinstance(tissue, Tissue):
        raise TypeError(f"Argument `tissue` must be a vertax.Tissue, but is {describe(tissue)}.")
    if np.ndim(tissue.vertices) != 2:
        raise ValueError(
            "Argument `tissue` must be one tissue, but its vertices have shape "
            f"{np.shape(tissue.vertices)}. Take a batch through equinox.filter_vmap."
        )
    if box is not None and not isinstance(tissue.boundary, Periodic):
        raise ValueError(
            f"Argument `tissue` must be periodic: {box} strains the box, and a free tissue has none."
        )
    if box is not None:
        check_planar(box, tissue)


def check_dissipation(dissipation: Any) -> None:
    """Raise a `TypeError` unless the argument is a dissipation."""
    if not isinstance(dissipation, AbstractDissipation):
        raise TypeError(
            "Argument `dissipation` must be a dissipation, e.g. vertax.dissipations.SubstrateFriction(1.0), "
            f"but is {describe(dissipation)}."
        )


def check_linear_solver(solver: Any) -> None:
    """Raise a `TypeError` unless the argument is a linear solver."""
    if not isinstance(solver, lx.AbstractLinearSolver):
        raise TypeError(
            "Argument `linear_solver` must be a linear solver, e.g. vertax.MINRES(), but is "
            f"{describe(solver)}."
        )


def check_relaxation(relaxation: Any) -> None:
    """Raise a `TypeError` unless the argument is a `Relaxation`."""
    if not isinstance(relaxation, Relaxation):
        raise TypeError(
            "Argument `relaxation` must be a vertax.Relaxation, but is "
            + describe(relaxation)
            + "."
        )


def as_angle(angle: ArrayLike) -> Float[Array, ""]:
    """An angle as a scalar array; a `ValueError` for any other shape."""
    value = as_real("angle", angle)
    if value.shape != ():
        raise ValueError(
            f"Argument `angle` must be one number, but its shape is {value.shape}. Take more of them through "
            "jax.vmap."
        )
    return value


def as_matrix(name: str, value: ArrayLike, *, symmetric: bool = False) -> Float[Array, "2 2"]:
    """A 2-by-2 matrix; a `ValueError` for any other shape, or if `symmetric` and it is not."""
    matrix = as_real(name, value)
    if matrix.shape != (2, 2):
        raise ValueError(
            f"Argument `{name}` must have shape (2, 2), but its shape is {matrix.shape}."
        )
    if symmetric and is_concrete(matrix):
        difference, size = abs(float(matrix[0, 1] - matrix[1, 0])), float(jnp.max(jnp.abs(matrix)))
        if difference > 1e-5 * size:
            raise ValueError(
                f"Argument `{name}` must be symmetric, but its off-diagonal entries are "
                f"{matrix[0, 1]} and {matrix[1, 0]}."
            )
    return matrix
