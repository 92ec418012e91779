"""What functions of mechanics are given: refused with the name of the argument and the remedy."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, describe
from vertax._base.tracing import is_concrete
from vertax.dissipations import AbstractDissipation
from vertax.energies._energy import check_energy
from vertax.mesh import Periodic, Tissue
from vertax.relax import Relaxation


def check_system(tissue: Any, energy: Any, *, box: str | None = None) -> None:
    """Refuse what is no tissue, or no energy.

    **Arguments:**

    - `tissue`: what is to be a single tissue.
    - `energy`: what is to be an energy.
    - `box`: what needs a periodic box, if something does, for the message.

    **Raises:**

    - `TypeError` for another object in the place of either.
    - `ValueError` for a batch of tissues, or a free tissue where a box is needed.
    """
    check_tissue(tissue, box=box)
    check_energy(energy)


def check_tissue(tissue: Any, *, box: str | None = None) -> None:
    """Refuse what is no tissue; see `check_system`."""
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


def check_dissipation(dissipation: Any) -> None:
    """Refuse what is no dissipation.

    **Raises:**

    - `TypeError` for it.
    """
    if not isinstance(dissipation, AbstractDissipation):
        raise TypeError(
            "Argument `dissipation` must be a dissipation, e.g. vertax.dissipations.SubstrateFriction(1.0), "
            f"but is {describe(dissipation)}."
        )


def check_linear_solver(solver: Any) -> None:
    """Refuse what is no linear solver.

    **Raises:**

    - `TypeError` for it.
    """
    if not isinstance(solver, lx.AbstractLinearSolver):
        raise TypeError(
            "Argument `linear_solver` must be a linear solver, e.g. vertax.MINRES(), but is "
            f"{describe(solver)}."
        )


def check_relaxation(relaxation: Any) -> None:
    """Refuse what is no relaxation.

    **Raises:**

    - `TypeError` for it.
    """
    if not isinstance(relaxation, Relaxation):
        raise TypeError(
            "Argument `relaxation` must be a vertax.Relaxation, but is "
            + describe(relaxation)
            + "."
        )


def as_angle(angle: ArrayLike) -> Float[Array, ""]:
    """An angle as an array.

    **Raises:**

    - `ValueError` for several of them.
    """
    value = as_real("angle", angle)
    if value.shape != ():
        raise ValueError(
            f"Argument `angle` must be one number, but its shape is {value.shape}. Take more of them through "
            "jax.vmap."
        )
    return value


def as_matrix(name: str, value: ArrayLike, *, symmetric: bool = False) -> Float[Array, "2 2"]:
    """A matrix of two rows.

    **Raises:**

    - `ValueError` for another shape, or one that should be symmetric and is not.
    """
    matrix = as_real(name, value)
    if matrix.shape != (2, 2):
        raise ValueError(
            f"Argument `{name}` must have shape (2, 2), but its shape is {matrix.shape}."
        )
    if symmetric and is_concrete(matrix):
        off, size = abs(float(matrix[0, 1] - matrix[1, 0])), float(jnp.max(jnp.abs(matrix)))
        if off > 1e-5 * size:
            raise ValueError(
                f"Argument `{name}` must be symmetric, but its entries beside the diagonal are "
                f"{matrix[0, 1]} and {matrix[1, 0]}."
            )
    return matrix
