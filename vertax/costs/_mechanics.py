"""What is wanted of stress, moduli and modes."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vertax import mechanics
from vertax._base.checks import as_real, check_integer, check_number, describe
from vertax._base.tracing import is_concrete
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mechanics._arguments import as_matrix
from vertax.mechanics._elasticity import shear_part, young_part
from vertax.mesh import Tissue

# Components xx, yy and √2 xy: the sum of their squares is that of all four.
_SHEAR = np.sqrt(2.0)


class Stress(AbstractLeastSquaresCost):
    r"""Distance of the stress of a tissue from one wanted, $\tfrac12 |\sigma - \sigma^t|^2$.

    **Arguments:**

    - `target`, shape `(2, 2)`: the symmetric stress to reach, energy per area, see
        [`stress`][vertax.mechanics.stress].

    **Raises:**

    - `ValueError` for another shape, or a matrix that is not symmetric.
    """

    target: Float[Array, "2 2"] = eqx.field(converter=partial(as_real, "target"))

    def __check_init__(self):
        as_matrix("target", self.target, symmetric=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The components of the difference."""
        return _components(mechanics.stress(tissue, energy) - self.target)


class CellStress(AbstractLeastSquaresCost):
    r"""Mean distance of the stress of chosen cells from one wanted, $\frac1{2n} \sum_c |\sigma_c -
    \sigma^t_c|^2$.

    **Arguments:**

    - `target`, shape `(2, 2)` or one for each of the chosen cells: symmetric stress, energy per area, see
        [`cell_stress`][vertax.mechanics.cell_stress].
    - `cells`: the numbers of the chosen cells; by default all.

    **Raises:**

    - `TypeError` for cells that are no whole numbers.
    - `ValueError` if targets and cells do not match, or a cell is none.
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
        """The components of the differences over the root of their number."""
        stresses = mechanics.cell_stress(tissue, energy)
        chosen = stresses
        if self.cells is not None:
            within = (self.cells >= 0) & (self.cells < tissue.n_cells)
            if is_concrete(within) and not within.all():
                raise ValueError(
                    f"Argument `cells` must hold numbers of cells, from 0 to {tissue.n_cells - 1}, but "
                    f"holds {self.cells[~within][0]}."
                )
            # A cell that is none has no stress, and not that of the last.
            chosen = stresses.at[self.cells].get(mode="fill", fill_value=jnp.nan)
        if self.target.shape not in ((2, 2), chosen.shape):
            raise ValueError(
                "The target of CellStress must have the shape (2, 2) or one entry for each chosen cell, "
                f"{chosen.shape}, but its shape is {self.target.shape}."
            )
        return _components(chosen - self.target) / jnp.sqrt(1.0 * chosen.shape[0])


class ShearModulus(AbstractLeastSquaresCost):
    r"""Distance of the shear modulus from one wanted, $\tfrac12 (G - G^t)^2$.

    **Arguments:**

    - `target`: the relaxed modulus to reach, energy per area.
    - `angle`: direction of the shear, see [`shear_modulus`][vertax.mechanics.shear_modulus]; by default
        the mean over all.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    angle: float | None = None

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        return (shear_part(_tensor(tissue, energy), self.angle) - self.target)[None]


class BulkModulus(AbstractLeastSquaresCost):
    r"""Distance of the bulk modulus from one wanted, $\tfrac12 (B - B^t)^2$.

    **Arguments:**

    - `target`: the relaxed modulus to reach, energy per area, see
        [`bulk_modulus`][vertax.mechanics.bulk_modulus].
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The difference."""
        check_number("target", self.target)
        return (jnp.sum(_tensor(tissue, energy)[:2, :2]) / 4 - self.target)[None]


class Anisotropy(AbstractLeastSquaresCost):
    r"""Distance of the anisotropy of the stiffness from one wanted, $\tfrac12 (a - a^t)^2$.

    $a = (Y_\parallel - Y_\perp) / (Y_\parallel + Y_\perp)$ with Young's moduli along a direction and
    across it.

    **Arguments:**

    - `target`: the anisotropy to reach, between -1 and 1; 0 for a tissue as stiff along as across.
    - `angle`: the direction, in radians from the x axis.

    **Raises:**

    - `ValueError` for a target that cannot be.
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
    r"""Distance of a gap between the eigenvalues of the Hessian from one wanted.

    $C = \tfrac12 (\lambda_{k+1} - \lambda_k - g)^2$, with eigenvalues in ascending order from
    $\lambda_1$ on.

    **Arguments:**

    - `target`: the gap $g$ to reach, energy per length squared.
    - `below`: how many modes $k$ are below the gap. In a periodic tissue 2 of them are the translations,
        and the default is the softest mode other than these.
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
    # A cost that is not known is NaN, which a fit notices; an error would end it.
    return mechanics.elastic_tensor(tissue, energy, throw=False)


def _components(stress: Float[Array, "*cells 2 2"]) -> Float[Array, " residuals"]:
    shear = (stress[..., 0, 1] + stress[..., 1, 0]) / _SHEAR
    return jnp.stack([stress[..., 0, 0], stress[..., 1, 1], shear]).ravel()
