"""Area and perimeter elasticity of cells."""

from __future__ import annotations

from functools import partial

import equinox as eqx
from jaxtyping import Array, Float

from vertax._base.checks import check_number
from vertax.energies._energy import AbstractLocalEnergy, OrFloat, as_parameter, per_cell
from vertax.mesh import Tissue


class ShapeFactorEnergy(AbstractLocalEnergy):
    r"""Dimensionless area and perimeter elasticity with a target shape factor for each cell.

    $$E_1 = \sum_c \left(\frac{A_c}{A_0} - 1\right)^2
          + \sum_c \left(\frac{P_c}{\sqrt{A_0}} - p^0_c\right)^2$$

    The paper's energy $E_1$; that of Bi et al. 2015, doi:10.1038/nphys3471, with equal moduli. A tissue of
    equal cells is rigid for $p_0$ below about 3.81 and fluid-like above.

    **Arguments:**

    - `target_shape_factor`: $p^0$, dimensionless; scalar or one per cell.
    - `mean_area`: $A_0$, in units of length squared; scalar or one per cell.

    **Raises:**

    - `ValueError` for a mean area that is not positive.
    """

    target_shape_factor: OrFloat[Float[Array, "*cells"]] = eqx.field(
        converter=partial(as_parameter, "target_shape_factor")
    )
    mean_area: OrFloat[Float[Array, "*cells"]] = eqx.field(
        default=1.0, converter=partial(as_parameter, "mean_area")
    )

    def __check_init__(self):
        check_number("mean_area", self.mean_area, above=0, many=True)

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        target = per_cell(self.target_shape_factor, tissue, "target_shape_factor")
        area = per_cell(self.mean_area, tissue, "mean_area")
        return (tissue.areas / area - 1) ** 2 + (tissue.perimeters / area**0.5 - target) ** 2


class AreaElasticity(AbstractLocalEnergy):
    r"""$\tfrac12\sum_c K_c\,(A_c - A^0_c)^2$ (Farhadifar et al. 2007, doi:10.1016/j.cub.2007.11.049).

    The sum with [`LineTension`][vertax.energies.LineTension] is the paper's energy $E_2$.

    **Arguments:**

    - `stiffness`: $K$, energy per area squared; scalar or one per cell.
    - `target_area`: $A^0$; scalar or one per cell.

    **Raises:**

    - `ValueError` for a negative stiffness, for which the energy has no minimum.
    """

    stiffness: OrFloat[Float[Array, "*cells"]] = eqx.field(
        converter=partial(as_parameter, "stiffness")
    )
    target_area: OrFloat[Float[Array, "*cells"]] = eqx.field(
        converter=partial(as_parameter, "target_area")
    )

    def __check_init__(self):
        check_number("stiffness", self.stiffness, at_least=0, many=True)

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        stiffness = per_cell(self.stiffness, tissue, "stiffness")
        target = per_cell(self.target_area, tissue, "target_area")
        return 0.5 * stiffness * (tissue.areas - target) ** 2

    def pressures(self, tissue: Tissue) -> Float[Array, " cells"]:
        r"""Pressure in each cell, $-\partial E/\partial A_c = K_c (A^0_c - A_c)$, energy per area."""
        stiffness = per_cell(self.stiffness, tissue, "stiffness")
        return stiffness * (per_cell(self.target_area, tissue, "target_area") - tissue.areas)


class PerimeterElasticity(AbstractLocalEnergy):
    r"""$\tfrac12\sum_c K_c\,(P_c - P^0_c)^2$ (Farhadifar et al. 2007, doi:10.1016/j.cub.2007.11.049).

    With `target_perimeter = 0` it is the perimeter contractility $\tfrac12\Gamma P^2$.

    **Arguments:**

    - `stiffness`: $K$, energy per length squared; scalar or one per cell.
    - `target_perimeter`: $P^0$; scalar or one per cell.

    **Raises:**

    - `ValueError` for a negative stiffness, for which the energy has no minimum.
    """

    stiffness: OrFloat[Float[Array, "*cells"]] = eqx.field(
        converter=partial(as_parameter, "stiffness")
    )
    target_perimeter: OrFloat[Float[Array, "*cells"]] = eqx.field(
        converter=partial(as_parameter, "target_perimeter")
    )

    def __check_init__(self):
        check_number("stiffness", self.stiffness, at_least=0, many=True)

    def cell_terms(self, tissue: Tissue) -> Float[Array, " cells"]:
        """Energy of each cell."""
        stiffness = per_cell(self.stiffness, tissue, "stiffness")
        target = per_cell(self.target_perimeter, tissue, "target_perimeter")
        return 0.5 * stiffness * (tissue.perimeters - target) ** 2
