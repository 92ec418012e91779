"""Costs of stress, elastic moduli and vibrational modes."""

from __future__ import annotations

import math
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vertax import mechanics
from vertax._base.checks import (
    as_matrix,
    as_real,
    check_integer,
    check_number,
    check_shape,
    describe,
)
from vertax._base.tracing import is_concrete
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mechanics._elasticity import shear_part, young_part
from vertax.mesh import Tissue

# With the components xx, yy and √2 xy, the sum of squares is that of all four components.
_SHEAR = math.sqrt(2.0)


class Stress(AbstractLeastSquaresCost):
    r"""Squared difference of the stress of a tissue and a target, $\tfrac12 |\sigma - \sigma^t|^2$.

    **Arguments:**

    - `target`, shape `(2, 2)`: the symmetric target stress $\sigma^t$, energy per area, see
        [`stress`][vertax.mechanics.stress].

    **Raises:**

    - `ValueError` for a wrong shape, or a matrix that is not symmetric.
    """

    target: Float[Array, "2 2"] = eqx.field(converter=partial(as_real, "target"))

    def __check_init__(self):
        as_matrix("target", self.target, symmetric=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The components of the difference."""
        return _components(mechanics.stress(tissue, energy) - self.target)


class CellStress(AbstractLeastSquaresCost):
    r"""Mean squared difference of the stresses of $n$ cells and targets.

    $$C = \frac1{2n} \sum_c |\sigma_c - \sigma^t_c|^2$$

    **Arguments:**

    - `target`, shape `(2, 2)` or one for each selected cell: symmetric stress, energy per area, see
        [`cell_stress`][vertax.mechanics.cell_stress].
    - `cells`: the indices of the selected cells; by default all.

    **Raises:**

    - `TypeError` for indices that are not integers.
    - `ValueError` if the numbers of targets and cells differ, or an index is out of range.
    """

    target: Float[Array, "*cells 2 2"] = eqx.field(converter=partial(as_real, "target"))
    cells: Int[Array, " chosen"] | None = eqx.field(
        default=None, converter=lambda cells: None if cells is None else jnp.asarray(cells)
    )

    def __check_init__(self):
        if self.cells is not None and not jnp.issubdtype(self.cells.dtype, jnp.integer):
            raise TypeError(
                f"Argument `cells` must hold whole numbers, but is {describe(self.cells)}."
            )

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""The components of the differences, over $\sqrt n$."""
        stresses = mechanics.cell_stress(tissue, energy)
        selected = stresses
        if self.cells is not None:
            within = (self.cells >= 0) & (self.cells < tissue.n_cells)
            if is_concrete(within) and not within.all():
                raise ValueError(
                    f"Argument `cells` must hold indices of cells, from 0 to {tissue.n_cells - 1}, but "
                    f"holds {self.cells[~within][0]}."
                )
            # An index out of range gives NaN; by default JAX would clip it to the last cell.
            selected = stresses.at[self.cells].get(mode="fill", fill_value=jnp.nan)
        remedy = "Give one stress, or one for each selected cell."
        check_shape("target", self.target, (2, 2), selected.shape, remedy=remedy)
        differences = selected - self.target
        if not tissue.topology.spare:
            return _components(differences) / jnp.sqrt(1.0 * len(differences))
        living = self._living(tissue)
        differences = jnp.where(living[:, None, None], differences, 0)
        return _components(differences) / jnp.sqrt(1.0 * jnp.sum(living))

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which components are those of a cell that exists."""
        return jnp.tile(self._living(tissue), 3)

    def _living(self, tissue: Tissue) -> Bool[Array, " chosen"]:
        """Which of the selected cells exist."""
        if self.cells is None:
            return tissue.alive
        return tissue.alive.at[self.cells].get(mode="fill", fill_value=True)


class ShearModulus(AbstractLeastSquaresCost):
    r"""Squared difference of the shear modulus and a target, $\tfrac12 (G - G^t)^2$.

    **Arguments:**

    - `target`: the target $G^t$ of the relaxed modulus, energy per area.
    - `angle`: direction of the shear, see [`shear_modulus`][vertax.mechanics.shear_modulus]; by default
        the mean over all directions.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    angle: float | None = None

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        return (shear_part(_tensor(tissue, energy), self.angle) - self.target)[None]


class BulkModulus(AbstractLeastSquaresCost):
    r"""Squared difference of the bulk modulus and a target, $\tfrac12 (B - B^t)^2$.

    **Arguments:**

    - `target`: the target $B^t$ of the relaxed modulus, energy per area, see
        [`bulk_modulus`][vertax.mechanics.bulk_modulus].
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        return (jnp.sum(_tensor(tissue, energy)[:2, :2]) / 4 - self.target)[None]


class Anisotropy(AbstractLeastSquaresCost):
    r"""Squared difference of the elastic anisotropy and a target, $\tfrac12 (a - a^t)^2$.

    $a = (Y_\parallel - Y_\perp) / (Y_\parallel + Y_\perp)$ with Young's moduli parallel and perpendicular to
    a direction.

    **Arguments:**

    - `target`: the target $a^t$, between -1 and 1; 0 for equal moduli.
    - `angle`: the direction, in radians from the x axis.

    **Raises:**

    - `ValueError` for a target outside (-1, 1).
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    angle: float = 0.0

    def __check_init__(self):
        if is_concrete(self.target) and not (abs(self.target) < 1).all():
            raise ValueError(f"Argument `target` must be between -1 and 1, but is {self.target}.")

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        tensor = _tensor(tissue, energy)
        along, across = (young_part(tensor, self.angle + turn) for turn in (0.0, np.pi / 2))
        return ((along - across) / (along + across) - self.target)[None]


class SpectralGap(AbstractLeastSquaresCost):
    r"""Squared difference of a gap in the spectrum of the Hessian and a target.

    $C = \tfrac12 (\lambda_{k+1} - \lambda_k - g)^2$ with eigenvalues $\lambda_1 \le \lambda_2 \le \dots$

    **Arguments:**

    - `target`: the target gap $g$, energy per length squared.
    - `below`: the number $k$ of modes below the gap. A periodic tissue has 2 translations of eigenvalue 0:
        with the default 2, the gap is the lowest eigenvalue of the other modes.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    below: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        check_integer("below", self.below, at_least=1)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        values = mechanics.modes(tissue, energy, self.below + 1, method="dense").values
        return (values[-1] - values[-2] - self.target)[None]


def _tensor(tissue: Tissue, energy: AbstractEnergy) -> Float[Array, "3 3"]:
    # Without an error a failed solve gives NaN, which a fit handles for each member of a batch.
    return mechanics.elastic_tensor(tissue, energy, throw=False)


def _components(stress: Float[Array, "*cells 2 2"]) -> Float[Array, " residuals"]:
    shear = (stress[..., 0, 1] + stress[..., 1, 0]) / _SHEAR
    return jnp.stack([stress[..., 0, 0], stress[..., 1, 1], shear]).ravel()
