"""The foam model E2 with a bounded tension for each edge."""

from __future__ import annotations

from jaxtyping import ArrayLike

from vertax.energies import AbstractEnergy, AreaElasticity, BoundedTension, LocalSum


def foam_energy(
    tension: ArrayLike,
    target_area: ArrayLike = 1.0,
    *,
    stiffness: float = 1.0,
    low: float = 0.04,
    high: float = 0.28,
) -> LocalSum:
    r"""The energy E2 with tensions that stay within bounds during a fit.

    $$E = \tfrac12 K \sum_c (A_c - A^0_c)^2 + \sum_e \gamma_e \ell_e$$

    **Arguments:**

    - `tension`: $\gamma$, scalar array or one an edge.
    - `target_area`: $A^0$, scalar or one a cell.
    - `stiffness`: $K$.
    - `low`, `high`: bounds of the tensions. If the largest is more than twice the smallest, some junctions of
        three edges cannot balance, and collapse to four-fold vertices.

    **Returns:** the sum of an [`AreaElasticity`][vertax.energies.AreaElasticity] and a
    [`BoundedTension`][vertax.energies.BoundedTension].

    **Raises:**

    - `ValueError` for bounds that are not ordered, or a tension not between them.
    """
    return LocalSum((AreaElasticity(stiffness, target_area), BoundedTension(tension, low, high)))


def foam_terms(energy: AbstractEnergy) -> tuple[AreaElasticity, BoundedTension]:
    """The two parts of an energy E2 with bounded tensions.

    **Arguments:**

    - `energy`: from [`foam_energy`][vertax.inference.foam_energy], or the result of a fit that started from
        it; or a batch.

    **Returns:** the energy of the areas, with its `pressures`, and that of the edges, with their `tension`.

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
