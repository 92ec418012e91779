"""What is wanted of the shapes and sizes of cells."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.checks import as_real, check_number
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class MeanShapeFactor(AbstractLeastSquaresCost):
    r"""Squared distance of the mean observed shape factor from a target (paper, "Inverse mechanical design").

    $$C = \left(\frac1N \sum_{c=1}^N \frac{P_c}{\sqrt{A_c}} - P_\mathrm{target}\right)^2$$

    with the shape factors that the cells have in equilibrium. (The paper's formula has the target shape
    factors $p^0_c$ of the energy instead, which no equilibrium is needed for. In a fluid tissue, where
    every cell attains its target, the two are the same.)

    **Arguments:**

    - `target`: the mean shape factor to reach, dimensionless.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The distance, times the root of 2: the paper's cost is the square, not half of it."""
        check_number("target", self.target)
        return jnp.sqrt(2.0) * (_mean(tissue, tissue.shape_factors) - self.target)[None]


class CellAreas(AbstractLeastSquaresCost):
    r"""Mean squared distance of the areas of cells from those wanted, $\frac1{2N}\sum_c (A_c - A^t_c)^2$.

    **Arguments:**

    - `target`: areas to reach; scalar or one per cell.

    **Raises:**

    - `ValueError` if the number of areas is not that of the cells, or one is not positive.
    """

    target: Float[Array, "*cells"] = eqx.field(converter=partial(as_real, "target"))

    def __check_init__(self):
        check_number("target", self.target, above=0, many=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Differences of areas over the root of the number of cells."""
        if self.target.shape not in ((), (tissue.n_cells,)):
            raise ValueError(
                "The target of CellAreas must be a scalar or have one entry per cell, shape "
                f"({tissue.n_cells},), but its shape is {self.target.shape}."
            )
        differences = tissue.areas - self.target
        if tissue.topology.spare:
            differences = jnp.where(tissue.alive, differences, 0)
            return differences / jnp.sqrt(1.0 * jnp.sum(tissue.alive))
        return differences / jnp.sqrt(1.0 * tissue.n_cells)


def _mean(tissue: Tissue, values: Float[Array, " cells"]) -> Float[Array, ""]:
    """The mean over the cells that there are; spare slots have 0."""
    return jnp.sum(values) / jnp.sum(tissue.alive) if tissue.topology.spare else jnp.mean(values)
