"""Friction with what a tissue lies on."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, check_number
from vertax.dissipations._dissipation import AbstractViscosity
from vertax.mesh import Tissue


class SubstrateFriction(AbstractViscosity):
    r"""Friction with a substrate, $R = \tfrac12 \sum_v \zeta_v |\dot x_v|^2$, so $\zeta \dot x = -\nabla E$.

    Where the box of the tissue is deformed the substrate goes with it: velocities are those relative to the
    affine motion (as in Tong et al. 2022, doi:10.1371/journal.pcbi.1010135).

    **Arguments:**

    - `coefficient`: $\zeta$, force over velocity; a scalar or one a vertex. With `per="area"` force over
        velocity and area.
    - `per`: what has that friction: each `"vertex"`, or each unit of `"area"`, which a cell shares out evenly
        among its vertices, as it is at the beginning of a step.

    **Raises:**

    - `ValueError` for a negative coefficient, one of another shape, or another `per`.
    """

    coefficient: Float[Array, "*vertices"]
    per: Literal["vertex", "area"] = eqx.field(static=True)

    def __init__(self, coefficient: ArrayLike, per: Literal["vertex", "area"] = "vertex"):
        self.coefficient = coefficient_of("coefficient", coefficient)
        if per not in ("vertex", "area"):
            raise ValueError(f'Argument `per` must be "vertex" or "area", but is {per!r}.')
        self.per = per

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Displacements from where the box carries the vertices, weighted."""
        home = before.boundary.carry(before.vertices, tissue.boundary)
        coefficient = entries(self.coefficient, tissue.n_vertices, "coefficient", "vertex")
        if self.per == "area":
            coefficient = coefficient * _areas_of_vertices(before)
        return (jnp.sqrt(coefficient)[:, None] * (tissue.vertices - home)).ravel()


def coefficient_of(name: str, value: ArrayLike) -> Float[Array, "*shape"]:
    """A coefficient as an array.

    **Raises:**

    - `ValueError` for what is negative or not finite.
    """
    check_number(name, value, at_least=0, many=True)
    return as_real(name, value)


def entries(
    values: Float[Array, "*shape"], size: int, name: str, what: str
) -> Float[Array, " entries"]:
    """One coefficient for each of so many things.

    **Raises:**

    - `ValueError` if there are neither one nor as many.
    """
    if values.shape not in ((), (size,)):
        raise ValueError(
            f"Argument `{name}` must be a scalar or have one entry for each {what}, shape ({size},), but "
            f"its shape is {values.shape}."
        )
    return jnp.broadcast_to(values, (size,))


def _areas_of_vertices(tissue: Tissue) -> Float[Array, " vertices"]:
    """The area that the cells around each vertex share out to it."""
    m = tissue.topology
    shares = jax.lax.stop_gradient(jnp.abs(tissue.areas)) / jnp.maximum(m.neighbour_counts, 1)
    # The exterior, and what is nowhere, have none.
    return jnp.sum(shares.at[m.cell].get(mode="fill", fill_value=0).reshape(-1, 3), axis=1)
