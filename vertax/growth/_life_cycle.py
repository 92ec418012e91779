"""Life cycles: rules of cell growth, division and death."""

from __future__ import annotations

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree

from vertax._base.checks import as_real, check_choice, check_number
from vertax._base.field_checks import check_fields
from vertax.mesh import Tissue


class AbstractLifeCycle(eqx.Module):
    """Rules of cell growth, division and death.

    The cell states are a pytree of arrays with one entry (or row) per cell. In a division both daughters
    inherit the state of the mother, before `born` modifies it. An array without an axis of cells must declare
    this in the metadata of its field, see [`Change.inherited`][vertax.transitions.Change].
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """The initial cell states."""

    @abc.abstractmethod
    def advance(
        self, cells: PyTree[Array], tissue: Tissue, dt: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[PyTree[Array], Bool[Array, " cells"]]:
        """The cell states after a time step, and which cells divide."""

    @abc.abstractmethod
    def born(
        self, cells: PyTree[Array], tissue: Tissue, pair: Int[Array, "2"], key: PRNGKeyArray
    ) -> PyTree[Array]:
        """The cell states after a division; the two slots `pair` hold the inherited state of the mother."""

    def log_likelihood(
        self,
        before: PyTree[Array],
        after: PyTree[Array],
        tissue: Tissue,
        dt: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Log-likelihood of the discrete random choices of `advance`, for `score_function`.

        Continuous random numbers, such as a division area, are not included: they are differentiated
        directly. By default 0, for a cycle without discrete choices.
        """
        return jnp.zeros((), tissue.vertices.dtype)

    def overdue(self, cells: PyTree[Array], tissue: Tissue) -> Bool[Array, " cells"]:
        """Which cells should have been removed before; `grow` counts them. By default none."""
        return jnp.zeros(tissue.n_cells, bool)

    def axis(
        self, cells: PyTree[Array], tissue: Tissue, cell: Int[Array, ""], key: PRNGKeyArray
    ) -> Float[Array, "2"] | None:
        """Direction from one daughter to the other; None is the long axis of the mother."""
        return None


class Cells(eqx.Module):
    """Cell states of [`GrowAndDivide`][vertax.growth.GrowAndDivide]."""

    target_area: Float[Array, "*batch cells"]
    """Target area of each cell."""
    division_area: Float[Array, "*batch cells"]
    """Target area at which each cell divides."""
    age: Float[Array, "*batch cells"]
    """Time since birth."""
    dying: Bool[Array, "*batch cells"]
    """Whether the cell shrinks until it is removed."""


class GrowAndDivide(AbstractLifeCycle):
    r"""Growth at a constant rate, division at a random size, and death at a constant rate.

    - Growth: the target area of a living cell obeys $\dot A^0 = g$.
    - Division: when $A^0$ reaches the division area of the cell, the cell divides, and each daughter gets
        $A^0 / 2$. The division area is drawn from a normal distribution, truncated to 0.6 to 1.9 times its
        mean and to at least 1.2 times the target area at birth.
    - Death: at the rate $k$ a cell starts to die; then $\dot A^0 = -A^0 / \tau$, until a T2 transition
        removes the cell.

    **Arguments:**

    - `growth_rate`: $g$, area over time.
    - `division_area`: mean target area at division.
    - `variation`: standard deviation of the normal distribution, relative to its mean.
    - `death_rate`: $k$, inverse time.
    - `shrinking_time`: $\tau$.
    - `orientation`: division along the `"long"` axis of the cell (Hertwig's rule) or a `"random"` one.

    **Raises:**

    - `ValueError` for negative rates, areas or times that are not positive, or an unknown orientation.
    """

    growth_rate: Float[Array, ""]
    division_area: Float[Array, ""]
    variation: Float[Array, ""]
    death_rate: Float[Array, ""]
    shrinking_time: Float[Array, ""]
    orientation: Literal["long", "random"] = eqx.field(static=True)

    def __init__(
        self,
        growth_rate: ArrayLike,
        division_area: ArrayLike,
        *,
        variation: ArrayLike = 0.1,
        death_rate: ArrayLike = 0.0,
        shrinking_time: ArrayLike = 1.0,
        orientation: Literal["long", "random"] = "long",
    ):
        check_number("growth_rate", growth_rate, at_least=0)
        check_number("division_area", division_area, above=0)
        check_number("variation", variation, at_least=0)
        check_number("death_rate", death_rate, at_least=0)
        check_number("shrinking_time", shrinking_time, above=0)
        check_choice("orientation", orientation, ("long", "random"))
        self.growth_rate = as_real("growth_rate", growth_rate)
        self.division_area = as_real("division_area", division_area)
        self.variation = as_real("variation", variation)
        self.death_rate = as_real("death_rate", death_rate)
        self.shrinking_time = as_real("shrinking_time", shrinking_time)
        self.orientation = orientation

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> Cells:
        """Cells at uniformly distributed stages between birth and division."""
        shape, dtype = (tissue.n_cells,), tissue.vertices.dtype
        area_key, stage_key = jax.random.split(key)
        division = self._draw_division_areas(area_key, jnp.zeros(shape, dtype))
        fraction = 0.5 * (1 + jax.random.uniform(stage_key, shape, dtype))
        return Cells(fraction * division, division, jnp.zeros(shape, dtype), jnp.zeros(shape, bool))

    def advance(
        self, cells: Cells, tissue: Tissue, dt: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[Cells, Bool[Array, " cells"]]:
        """The cell states after a time step, and which cells divide."""
        uniform = jax.random.uniform(key, cells.age.shape, cells.age.dtype)
        dying = cells.dying | (uniform < -jnp.expm1(-self.death_rate * dt))
        shrunk = cells.target_area * jnp.exp(-dt / self.shrinking_time)
        target = jnp.where(dying, shrunk, cells.target_area + self.growth_rate * dt)
        divides = ~dying & (target >= cells.division_area)
        return Cells(target, cells.division_area, cells.age + dt, dying), divides

    def log_likelihood(
        self, before: Cells, after: Cells, tissue: Tissue, dt: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Log-likelihood of the cells that started to die, and of those that did not."""
        hazard = self.death_rate * dt
        no_deaths = hazard == 0  # no deaths; avoids the derivative of log(0)
        dies = jnp.log(-jnp.expm1(-jnp.where(no_deaths, 1, hazard)))
        log_probability = jnp.where(after.dying & ~no_deaths, dies, -hazard)
        at_risk = tissue.alive & ~before.dying
        return jnp.sum(jnp.where(at_risk, log_probability, 0)).astype(tissue.vertices.dtype)

    def overdue(self, cells: Cells, tissue: Tissue) -> Bool[Array, " cells"]:
        """Dying cells with a target area below 1e-3 of their division area."""
        return cells.dying & (cells.target_area < 1e-3 * cells.division_area)

    def born(self, cells: Cells, tissue: Tissue, pair: Int[Array, "2"], key: PRNGKeyArray) -> Cells:
        """Halve the target areas, draw division areas and reset the ages of two daughters."""
        birth_areas = 0.5 * cells.target_area[pair]
        return Cells(
            cells.target_area.at[pair].set(birth_areas),
            cells.division_area.at[pair].set(self._draw_division_areas(key, birth_areas)),
            cells.age.at[pair].set(0),
            cells.dying,
        )

    def axis(
        self, cells: Cells, tissue: Tissue, cell: Int[Array, ""], key: PRNGKeyArray
    ) -> Float[Array, "2"] | None:
        """None (the long axis) or a random direction."""
        if self.orientation == "long":
            return None
        angle = jax.random.uniform(key, (), tissue.vertices.dtype, 0, jnp.pi)
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def _draw_division_areas(
        self, key: PRNGKeyArray, birth_areas: Float[Array, "*shape"]
    ) -> Float[Array, "*shape"]:
        """Division areas of cells with these target areas at birth.

        The distribution is normal, with a mean of `division_area`, between 0.6 and 1.9 times this mean. The
        lower limit is raised to 1.2 times the birth area: the daughters of a large mother do not divide at
        once.
        """
        shape, dtype = birth_areas.shape, birth_areas.dtype
        lowest = jnp.clip(1.2 * birth_areas / self.division_area, 0.6, 1.8)
        width = jnp.where(self.variation > 0, self.variation, 1)
        limits = ((lowest - 1) / width).astype(dtype), ((1.9 - 1) / width).astype(dtype)
        relative = 1 + self.variation * jax.random.truncated_normal(key, *limits, shape, dtype)
        return (self.division_area * relative).astype(dtype)
