"""What every cost is, and how costs are weighted and added."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.batch import member
from vertax._base.checks import check_number
from vertax._base.field_checks import check_fields
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractCost(eqx.Module):
    """What we want of an equilibrium, as a number to minimise.

    Subclass it and write `__call__`; data and settings are fields. Weighted sums are written as such:
    `0.99 * cost_a + 0.01 * cost_b`.
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Cost of a relaxed tissue and the energy that it minimises."""

    @property
    def of_frames(self) -> bool:
        """Whether it is to see all frames of a movement, a tissue with a leading axis of times.

        By default False: it sees one tissue, the last. See [`Frames`][vertax.costs.Frames].
        """
        return False

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The numbers of which the cost is half the sum of squares.

        **Raises:**

        - `TypeError` if the cost is no sum of squares (see
            [`AbstractLeastSquaresCost`][vertax.costs.AbstractLeastSquaresCost]).
        """
        raise TypeError(
            f"{type(self).__name__} is no sum of squares, which a least-squares solver needs: subclass "
            "vertax.costs.AbstractLeastSquaresCost, or fit with an Optax optimiser."
        )

    def __add__(self, other: AbstractCost) -> AbstractCost:
        """The sum of two costs."""
        if not isinstance(other, AbstractCost):
            return NotImplemented
        (weights, costs), (more_weights, more_costs) = _parts(self), _parts(other)
        return WeightedSum(jnp.concatenate([weights, more_weights]), costs + more_costs)

    def __mul__(self, weight: ArrayLike) -> AbstractCost:
        """The cost times a number."""
        if isinstance(weight, AbstractCost):
            return NotImplemented
        check_number("weight (of a cost)", weight)
        weights, costs = _parts(self)
        return WeightedSum(jnp.asarray(weight) * weights, costs)

    __rmul__ = __mul__
    # A NumPy array on the left would make an array of costs.
    __array_ufunc__ = None

    def __radd__(self, other: int) -> AbstractCost:
        """What `sum` of some costs begins with: 0 and the first one."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


class AbstractLeastSquaresCost(AbstractCost):
    """A cost that is half a sum of squares.

    Subclass it and write `residuals` instead of `__call__`; such a cost also serves second-order
    solvers like `optimistix.LevenbergMarquardt` in [`fit`][vertax.fit].
    """

    @abc.abstractmethod
    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The numbers of which the cost is half the sum of squares."""

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Half the sum of the squared residuals."""
        return 0.5 * jnp.sum(self.residuals(tissue, energy) ** 2)


class WeightedSum(AbstractCost):
    """A weighted sum of costs; made by `*` and `+`."""

    weights: Float[Array, " costs"]
    costs: tuple[AbstractCost, ...]

    @property
    def of_frames(self) -> bool:
        """Whether one of the terms sees all frames; others see the last one then."""
        return any(cost.of_frames for cost in self.costs)

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Weighted sum of the costs."""
        values = [cost(self._seen(cost, tissue), energy) for cost in self.costs]
        return jnp.sum(self.weights * jnp.stack(values))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals of all terms, times the roots of the weights.

        **Raises:**

        - `RuntimeError` (of Equinox, also inside `jax.jit`) for a negative weight, of which there is no root.
        - `TypeError` if a term is no sum of squares.
        """
        weights = eqx.error_if(
            self.weights,
            self.weights < 0,
            "A weighted sum of costs with a negative weight is no sum of squares, which a least-squares "
            "solver needs: make the weight positive, or fit with an Optax optimiser.",
        )
        roots = jnp.sqrt(weights)
        parts = [cost.residuals(self._seen(cost, tissue), energy) for cost in self.costs]
        return jnp.concatenate([root * part for root, part in zip(roots, parts, strict=True)])

    def _seen(self, cost: AbstractCost, tissue: Tissue) -> Tissue:
        return member(tissue, -1) if self.of_frames and not cost.of_frames else tissue


def _parts(cost: AbstractCost) -> tuple[Float[Array, " costs"], tuple[AbstractCost, ...]]:
    if isinstance(cost, WeightedSum):
        return cost.weights, cost.costs
    return jnp.ones(1), (cost,)
