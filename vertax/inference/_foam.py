"""The foam model E2 with a bounded tension for each edge, and the balance of forces in a given shape."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float
from scipy.optimize import lsq_linear

from vertax.energies import AbstractEnergy, AreaElasticity, BoundedTension, LocalSum
from vertax.mesh import Tissue


def foam_energy(
    tension: ArrayLike,
    target_area: ArrayLike = 1.0,
    *,
    stiffness: float = 1.0,
    low: float = 0.04,
    high: float = 0.28,
) -> LocalSum:
    r"""The energy E2 with tensions that a fit cannot drive out of bounds.

    $$E = \tfrac12 K \sum_c (A_c - A^0_c)^2 + \sum_e \gamma_e \ell_e$$

    **Arguments:**

    - `tension`: $\gamma$, scalar array or one an edge.
    - `target_area`: $A^0$, scalar or one a cell.
    - `stiffness`: $K$.
    - `low`, `high`: bounds of the tensions. Above twice the least one there are junctions of three edges
        without a balance, which close to four-fold vertices.

    **Returns:** the sum of an [`AreaElasticity`][vertax.energies.AreaElasticity] and a
    [`BoundedTension`][vertax.energies.BoundedTension].

    **Raises:**

    - `ValueError` for bounds that are not ordered, or a tension not between them.
    """
    return LocalSum((AreaElasticity(stiffness, target_area), BoundedTension(tension, low, high)))


def foam_terms(energy: AbstractEnergy) -> tuple[AreaElasticity, BoundedTension]:
    """The two parts of an energy E2 whose tensions have bounds.

    **Arguments:**

    - `energy`: of [`foam_energy`][vertax.inference.foam_energy], or of a fit that began with it; or a batch.

    **Returns:** the part of the areas, with its `pressures`, and that of the edges, with their `tension`.

    **Raises:**

    - `TypeError` for another energy.
    """
    if isinstance(energy, LocalSum) and len(energy.terms) == 2:
        area, tension = energy.terms
        if isinstance(area, AreaElasticity) and isinstance(tension, BoundedTension):
            return area, tension
    raise TypeError(
        "Argument `energy` must be a sum of AreaElasticity and BoundedTension, as made by foam_energy, but "
        f"is {type(energy).__name__}."
    )


def force_balance(
    tissue: Tissue,
    *,
    stiffness: float = 20.0,
    low: float = 0.05,
    high: float = 4.0,
    prior: float = 0.5,
) -> LocalSum:
    r"""Tensions and pressures that come closest to a balance of forces in a given shape.

    Forces on vertices and angles are linear in both, so this is a linear least-squares problem, with the
    mean tension 1. A shape tells tensions and pressures but for one factor.

    **Arguments:**

    - `tissue`: the shape.
    - `stiffness`: of the areas, relative to the mean tension.
    - `low`, `high`: bounds of the tensions, on both sides of 1.
    - `prior`: standard deviation of the tensions before the shape was seen; it decides what that leaves
        open.

    **Returns:** the energy E2 (see [`foam_energy`][vertax.inference.foam_energy]) with these tensions, and
    with target areas that make these pressures.

    **Raises:**

    - `ValueError` for bounds that do not enclose 1, or a stiffness or prior that is not positive.
    """
    if not 0 <= low < 1 < high:
        raise ValueError(
            "Arguments `low` and `high` must lie on both sides of 1, the mean tension, but are "
            f"{low} and {high}."
        )
    if not stiffness > 0 or not prior > 0:
        raise ValueError(
            f"Arguments `stiffness` and `prior` must be positive, but are {stiffness} and {prior}."
        )
    position, unravel = ravel_pytree(tissue.configuration)

    def measures(x: Float[Array, " n"]) -> Float[Array, " edges_and_cells"]:
        at = tissue.with_configuration(unravel(x))
        return jnp.concatenate([at.edge_lengths, -at.areas])

    forces = np.asarray(jax.jit(jax.jacrev(measures))(position)).T
    n_edges, n_cells = tissue.n_edges, tissue.n_cells
    # A typical force is one tension; the prior counts as much as a hundredth of one.
    prior_rows = 0.01 / prior * np.eye(n_edges, n_edges + n_cells)
    mean = np.concatenate([np.full(n_edges, 1e3 / n_edges), np.zeros(n_cells)])
    matrix = np.vstack([forces, prior_rows, mean])
    right = np.concatenate([np.zeros(len(forces)), prior_rows.sum(axis=1), [1e3]])
    margin = 1e-3 * (high - low)
    least = np.concatenate([np.full(n_edges, low + margin), np.full(n_cells, -np.inf)])
    most = np.concatenate([np.full(n_edges, high - margin), np.full(n_cells, np.inf)])
    solution = np.asarray(lsq_linear(matrix, right, (least, most)).x)
    tension, pressure = np.split(solution, [n_edges])
    areas = tissue.areas + jnp.asarray(pressure / stiffness)
    return foam_energy(jnp.asarray(tension), areas, stiffness=stiffness, low=low, high=high)
