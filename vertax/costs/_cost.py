"""Abstract costs and weighted sums of costs."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from vertax._base.batch import member
from vertax._base.checks import check_number
from vertax._base.field_checks import check_fields
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractCost(eqx.Module):
    """A number to minimise, as a function of an equilibrium and its energy.

    Subclass it and write `__call__`; data and settings are fields. Costs can be weighted and added:
    `0.99 * cost_a + 0.01 * cost_b`.
    """

    def __check_init__(self):
        check_fields(self)

    @abc.abstractmethod
    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Cost of a relaxed tissue and its energy."""

    @property
    def of_frames(self) -> bool:
        """Whether `__call__` takes all frames of an evolution, as a tissue with a leading axis of times.

        By default False: it takes the last frame. See [`Frames`][vertax.costs.Frames].
        """
        return False

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals: the cost is half the sum of their squares.

        **Raises:**

        - `TypeError` if the cost is not a sum of squares (see
            [`AbstractLeastSquaresCost`][vertax.costs.AbstractLeastSquaresCost]).
        """
        raise TypeError(
            "The cost must be a sum of squares for a least-squares solver, but "
            f"{type(self).__name__} is not. Subclass vertax.costs.AbstractLeastSquaresCost, or fit with an "
            "Optax optimiser."
        )

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which residuals are measurements; by default all.

        The others have no data and are 0 for every parameter, as those of spare slots and of pixels of
        weight 0. [`uncertainty`][vertax.uncertainty] and [`LogPosterior`][vertax.bayes.LogPosterior] do not
        count them.
        """
        return jnp.ones(eqx.filter_eval_shape(self.residuals, tissue, energy).shape, bool)

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
    # Without this, a NumPy array times a cost would be an array of costs.
    __array_ufunc__ = None

    def __radd__(self, other: int) -> AbstractCost:
        """The cost itself for 0, with which the built-in `sum` starts."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


class AbstractLeastSquaresCost(AbstractCost):
    """A cost that is half a sum of squares.

    Subclass it and write `residuals` instead of `__call__`. [`fit`][vertax.fit] can also minimise such a cost
    with a least-squares solver, e.g. `optimistix.LevenbergMarquardt`.
    """

    @abc.abstractmethod
    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals: the cost is half the sum of their squares."""

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Half the sum of the squared residuals."""
        return 0.5 * jnp.sum(self.residuals(tissue, energy) ** 2)


class WeightedSum(AbstractCost):
    """A weighted sum of costs; made by `*` and `+`."""

    weights: Float[Array, " costs"]
    costs: tuple[AbstractCost, ...]

    @property
    def of_frames(self) -> bool:
        """Whether one of the terms takes all frames; the other terms then take the last one."""
        return any(cost.of_frames for cost in self.costs)

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """Weighted sum of the costs."""
        values = [cost(self._argument_of(cost, tissue), energy) for cost in self.costs]
        return jnp.sum(self.weights.astype(tissue.vertices.dtype) * jnp.stack(values))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals of all terms, times the square roots of the weights.

        **Raises:**

        - `RuntimeError` (of Equinox, also inside `jax.jit`) for a negative weight.
        - `TypeError` if a term is not a sum of squares.
        """
        weights = eqx.error_if(
            self.weights,
            self.weights < 0,
            "A weighted sum of costs must be a sum of squares for a least-squares solver, but has a negative "
            "weight. Make the weight positive, or fit with an Optax optimiser.",
        )
        roots = jnp.sqrt(weights).astype(tissue.vertices.dtype)
        parts = [cost.residuals(self._argument_of(cost, tissue), energy) for cost in self.costs]
        return jnp.concatenate([root * part for root, part in zip(roots, parts, strict=True)])

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which residuals are measurements; none of a term of weight 0."""
        parts = [
            cost.is_measurement(self._argument_of(cost, tissue), energy) for cost in self.costs
        ]
        return jnp.concatenate(
            [(weight > 0) & part for weight, part in zip(self.weights, parts, strict=True)]
        )

    def _argument_of(self, cost: AbstractCost, tissue: Tissue) -> Tissue:
        """The frame or frames of which a term is evaluated."""
        return member(tissue, -1) if self.of_frames and not cost.of_frames else tissue


def _parts(cost: AbstractCost) -> tuple[Float[Array, " costs"], tuple[AbstractCost, ...]]:
    if isinstance(cost, WeightedSum):
        return cost.weights, cost.costs
    return jnp.ones(1), (cost,)
