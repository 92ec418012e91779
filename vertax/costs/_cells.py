"""Costs of cell shapes and cell areas."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.checks import as_real, check_number, check_shape
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class MeanShapeFactor(AbstractLeastSquaresCost):
    r"""Squared difference of the mean shape factor and a target (paper, "Inverse mechanical design").

    $$C = \left(\frac1N \sum_{c=1}^N \frac{P_c}{\sqrt{A_c}} - P_\mathrm{target}\right)^2$$

    with the shape factors of the cells at equilibrium. The formula in the paper has the target shape factors
    $p^0_c$ of the energy instead, which do not depend on the equilibrium. In a fluid tissue every cell
    attains its target, and the two agree.

    **Arguments:**

    - `target`: the target of the mean shape factor, dimensionless.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""$\sqrt2$ times the difference, because the cost is half the sum of squares."""
        check_number("target", self.target)
        return jnp.sqrt(2.0) * (_mean(tissue, tissue.shape_factors) - self.target)[None]


class CellAreas(AbstractLeastSquaresCost):
    r"""Half the mean squared difference of cell areas and targets, $\frac1{2N}\sum_c (A_c - A^t_c)^2$.

    **Arguments:**

    - `target`: target areas $A^t$; scalar or one per cell.

    **Raises:**

    - `ValueError` for an area that is not positive, or for a wrong number of areas.
    """

    target: Float[Array, "*cells"] = eqx.field(converter=partial(as_real, "target"))

    def __check_init__(self):
        check_number("target", self.target, above=0, many=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""$(A_c - A^t_c) / \sqrt N$."""
        remedy = "Give one area, or one for each cell."
        check_shape("target", self.target, (), (tissue.n_cells,), remedy=remedy)
        differences = tissue.areas - self.target
        if tissue.topology.spare:
            differences = jnp.where(tissue.alive, differences, 0)
            return differences / jnp.sqrt(1.0 * jnp.sum(tissue.alive))
        return differences / jnp.sqrt(1.0 * tissue.n_cells)

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which cells exist."""
        return tissue.alive


def _mean(tissue: Tissue, values: Float[Array, " cells"]) -> Float[Array, ""]:
    """The mean over living cells of values that are 0 in spare slots."""
    return jnp.sum(values) / jnp.sum(tissue.alive) if tissue.topology.spare else jnp.mean(values)
