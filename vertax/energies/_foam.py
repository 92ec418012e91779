"""The foam model E2 with a bounded tension for each edge."""

from __future__ import annotations

from jaxtyping import ArrayLike

from vertax.energies._elasticity import AreaElasticity
from vertax.energies._energy import LocalSum
from vertax.energies._tension import BoundedTension


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
    - `low`, `high`: bounds of the tensions. If `high > 2 * low`, some junctions of three edges may collapse.

    **Returns:** the sum of an [`AreaElasticity`][vertax.energies.AreaElasticity] and a
    [`BoundedTension`][vertax.energies.BoundedTension]; these two are its `terms`.

    **Raises:**

    - `ValueError` for bounds that are not ordered, or a tension not between them.
    """
    return LocalSum((AreaElasticity(stiffness, target_area), BoundedTension(tension, low, high)))
