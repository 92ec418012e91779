"""Life cycles: when a cell divides, and when it dies."""

from __future__ import annotations

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, PyTree

from vertax._base.checks import as_real, check_number
from vertax._base.field_checks import check_fields
from vertax.mesh import Tissue


class AbstractLifeCycle(eqx.Module):
    """What cells do in time besides moving: how they age, when they divide, and along which axis.

    What a cell knows of itself is a pytree of arrays with one entry (or row) a cell; a daughter begins with
    that of her mother. An array that has not, declares it by the metadata of its field, see
    [`Change.inherited`][vertax.transitions.Change].
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def init(self, tissue: Tissue, key: PRNGKeyArray) -> PyTree[Array]:
        """What the first cells know."""

    @abc.abstractmethod
    def advance(
        self, cells: PyTree[Array], tissue: Tissue, dt: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[PyTree[Array], Bool[Array, " cells"]]:
        """What they know some time later, and which of them divide now."""

    @abc.abstractmethod
    def born(
        self, cells: PyTree[Array], tissue: Tissue, pair: Int[Array, "2"], key: PRNGKeyArray
    ) -> PyTree[Array]:
        """What two daughters know, who have begun with what their mother knew."""

    def log_likelihood(
        self,
        before: PyTree[Array],
        after: PyTree[Array],
        tissue: Tissue,
        dt: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The logarithm of how likely `advance` made the choices that it made, for `score_function`.

        Of choices that are discrete alone: what is drawn from a distribution and goes on as a number, such as
        a size, is differentiated as such. By default 0, that of a cycle without choices.
        """
        return jnp.zeros((), tissue.vertices.dtype)

    def overdue(self, cells: PyTree[Array], tissue: Tissue) -> Bool[Array, " cells"]:
        """Which cells should have vanished by now; `grow` counts those that have not. By default none."""
        return jnp.zeros(tissue.n_cells, bool)

    def axis(
        self, cells: PyTree[Array], tissue: Tissue, cell: Int[Array, ""], key: PRNGKeyArray
    ) -> Float[Array, "2"] | None:
        """Along which axis a cell divides; None is its long one."""
        return None


class Cells(eqx.Module):
    """What a cell of [`GrowAndDivide`][vertax.growth.GrowAndDivide] knows of itself."""

    target_area: Float[Array, "*batch cells"]
    """The area that it would like to have."""
    division_area: Float[Array, "*batch cells"]
    """The target area at which it divides."""
    age: Float[Array, "*batch cells"]
    """Time since its birth."""
    dying: Bool[Array, "*batch cells"]
    """Whether it shrinks, and will vanish."""


class GrowAndDivide(AbstractLifeCycle):
    r"""Cells whose target areas grow, that divide at a certain size, and die at a certain rate.

    The target area of a cell grows by $g$ in time. When it comes to the size of division, which is drawn for
    each cell from a normal distribution, the cell divides, and each daughter has half its target area. A cell
    that dies shrinks, $\dot A^0 = -A^0 / \tau$, and leaves by T1 and T2 transitions.

    **Arguments:**

    - `growth_rate`: $g$, area over time.
    - `division_area`: mean target area at which a cell divides.
    - `variation`: standard deviation of that over its mean.
    - `death_rate`: how likely a cell begins to die in unit time.
    - `shrinking_time`: $\tau$.
    - `orientation`: a cell divides along its `"long"` axis (Hertwig's rule), or a `"random"` one.

    **Raises:**

    - `ValueError` for negative rates, areas or times that are not positive, or another orientation.
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
        if orientation not in ("long", "random"):
            raise ValueError(
                f'Argument `orientation` must be "long" or "random", but is {orientation!r}.'
            )
        self.growth_rate = as_real("growth_rate", growth_rate)
        self.division_area = as_real("division_area", division_area)
        self.variation = as_real("variation", variation)
        self.death_rate = as_real("death_rate", death_rate)
        self.shrinking_time = as_real("shrinking_time", shrinking_time)
        self.orientation = orientation

    def init(self, tissue: Tissue, key: PRNGKeyArray) -> Cells:
        """Cells at random stages between birth and division."""
        shape, dtype = (tissue.n_cells,), tissue.vertices.dtype
        drawn, stage = jax.random.split(key)
        division = self._drawn(drawn, shape, dtype)
        share = 0.5 * (1 + jax.random.uniform(stage, shape, dtype))
        return Cells(share * division, division, jnp.zeros(shape, dtype), jnp.zeros(shape, bool))

    def advance(
        self, cells: Cells, tissue: Tissue, dt: Float[Array, ""], key: PRNGKeyArray
    ) -> tuple[Cells, Bool[Array, " cells"]]:
        """Cells that are larger, and older."""
        strikes = jax.random.uniform(key, cells.age.shape, cells.age.dtype)
        dying = cells.dying | (strikes < -jnp.expm1(-self.death_rate * dt))
        fading = cells.target_area * jnp.exp(-dt / self.shrinking_time)
        target = jnp.where(dying, fading, cells.target_area + self.growth_rate * dt)
        divides = ~dying & (target >= cells.division_area)
        return Cells(target, cells.division_area, cells.age + dt, dying), divides

    def log_likelihood(
        self, before: Cells, after: Cells, tissue: Tissue, dt: Float[Array, ""]
    ) -> Float[Array, ""]:
        """That of those cells to die that did, and of the others not to."""
        spent = self.death_rate * dt
        certain = spent == 0  # where the logarithm has no derivative, nobody dies
        dies = jnp.log(-jnp.expm1(-jnp.where(certain, 1, spent)))
        each = jnp.where(after.dying & ~certain, dies, -spent)
        could = tissue.alive & ~before.dying
        return jnp.sum(jnp.where(could, each, 0)).astype(tissue.vertices.dtype)

    def overdue(self, cells: Cells, tissue: Tissue) -> Bool[Array, " cells"]:
        """Dying cells that aim at less than a thousandth of the area at which they would divide."""
        return cells.dying & (cells.target_area < 1e-3 * cells.division_area)

    def born(self, cells: Cells, tissue: Tissue, pair: Int[Array, "2"], key: PRNGKeyArray) -> Cells:
        """Two cells of half the size."""
        return Cells(
            cells.target_area.at[pair].set(0.5 * cells.target_area[pair]),
            cells.division_area.at[pair].set(self._drawn(key, (2,), cells.age.dtype)),
            cells.age.at[pair].set(0),
            cells.dying,
        )

    def axis(
        self, cells: Cells, tissue: Tissue, cell: Int[Array, ""], key: PRNGKeyArray
    ) -> Float[Array, "2"] | None:
        """The long axis, or a random one."""
        if self.orientation == "long":
            return None
        angle = jax.random.uniform(key, (), tissue.vertices.dtype, 0, jnp.pi)
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def _drawn(
        self, key: PRNGKeyArray, shape: tuple[int, ...], dtype: jnp.dtype
    ) -> Float[Array, "*shape"]:
        # (No cell divides at birth, however wide the distribution is.)
        relative = 1 + self.variation * jax.random.normal(key, shape, dtype)
        return (self.division_area * jnp.clip(relative, 0.6, 1.9)).astype(dtype)
