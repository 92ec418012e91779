"""Friction with a substrate."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, check_choice, check_number, check_shape
from vertax.dissipations._dissipation import AbstractViscosity
from vertax.mesh import Tissue


class SubstrateFriction(AbstractViscosity):
    r"""Friction with a substrate, $R = \tfrac12 \sum_v \zeta_v |\dot x_v|^2$, so $\zeta \dot x = -\nabla E$.

    If the periodic box deforms, the substrate deforms affinely with it, and velocities are relative to this
    affine motion (Tong et al. 2022, doi:10.1371/journal.pcbi.1010135). On a
    [surface][vertax.surfaces.AbstractSurface] velocities are those in space, so
    $\zeta J^T J \dot x = -\nabla E$ in the chart.

    **Arguments:**

    - `coefficient`: $\zeta$, force over velocity; a scalar or one per vertex. With `per="area"` force over
        velocity and area.
    - `per`: whether the coefficient is that of each `"vertex"` or that of a unit of `"area"`. The area of a
        cell, at the start of the step, is divided equally among its vertices.

    **Raises:**

    - `ValueError` for a negative coefficient, a wrong shape, or an unknown `per`.
    """

    coefficient: Float[Array, "*vertices"]
    per: Literal["vertex", "area"] = eqx.field(static=True)

    def __init__(self, coefficient: ArrayLike, per: Literal["vertex", "area"] = "vertex"):
        self.coefficient = as_coefficient("coefficient", coefficient)
        check_choice("per", per, ("vertex", "area"))
        self.per = per

    def strains(self, tissue: Tissue, before: Tissue) -> Float[Array, " strains"]:
        """Displacements relative to the affine motion of the box, times the roots of the coefficients."""
        if tissue.surface is None:
            reference = before.boundary.carry(before.vertices, tissue.boundary)
            moved = tissue.vertices - reference
        else:
            now, then = (tissue.surface.points(t.vertices) for t in (tissue, before))
            moved = (now - then).astype(tissue.vertices.dtype)
        coefficient = broadcast_coefficient(
            self.coefficient, tissue.n_vertices, "coefficient", "vertex"
        )
        if self.per == "area":
            coefficient = coefficient * _vertex_areas(before)
        return (jnp.sqrt(coefficient)[:, None] * moved).ravel()


def as_coefficient(name: str, value: ArrayLike) -> Float[Array, "*shape"]:
    """Convert a coefficient to an array.

    **Raises:**

    - `ValueError` for a negative number, NaN or infinity.
    """
    check_number(name, value, at_least=0, many=True)
    return as_real(name, value)


def broadcast_coefficient(
    values: Float[Array, "*shape"], size: int, name: str, item: str
) -> Float[Array, " entries"]:
    """Broadcast coefficients to one per item (vertex, edge or cell).

    **Raises:**

    - `ValueError` unless there is one coefficient, or one per item.
    """
    check_shape(name, values, (), (size,), remedy=f"Give one number, or one for each {item}.")
    return jnp.broadcast_to(values, (size,))


def _vertex_areas(tissue: Tissue) -> Float[Array, " vertices"]:
    """Area of each vertex: for each adjacent cell, its area divided by its number of vertices."""
    m = tissue.topology
    area_per_vertex = jax.lax.stop_gradient(jnp.abs(tissue.areas)) / jnp.maximum(
        m.neighbour_counts, 1
    )
    # The exterior and spare slots have no area: their labels are out of range and give 0.
    return jnp.sum(area_per_vertex.at[m.cell].get(mode="fill", fill_value=0).reshape(-1, 3), axis=1)
