"""Costs of the frames of an evolution."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from vertax._base.batch import stack
from vertax._base.checks import describe
from vertax.costs._cost import AbstractCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Frames(AbstractCost):
    r"""Sum of the costs of single frames of an evolution, $C = \sum_k C_k(x(t_k))$.

    ```python
    cost = vx.costs.Frames([vx.costs.VertexDistance(tissue) for tissue in observed[1:]])
    problem = vx.InverseProblem(observed[0], energy, cost, response=vx.Evolution(friction, times))
    ```

    If the $C_k$ are sums of squares, so is $C$, and least-squares solvers and
    [`uncertainty`][vertax.uncertainty] apply. A custom cost that depends on several frames at once overrides
    the property `of_frames` to return True; it is called with a tissue that has a leading axis of times.

    **Arguments:**

    - `costs`: one cost for each time after the first, all of one class and size. The first frame is the given
        tissue and has no cost.

    **Raises:**

    - `TypeError` unless all are costs of single tissues.
    - `ValueError` for no costs, or for costs of different classes or sizes.
    """

    costs: AbstractCost
    """The costs, stacked along a leading axis."""

    def __init__(self, costs: Sequence[AbstractCost]):
        costs = list(costs)
        for number, cost in enumerate(costs):
            if not isinstance(cost, AbstractCost) or cost.of_frames:
                raise TypeError(
                    "Argument `costs` of Frames must hold costs of single tissues, one for each time after "
                    f"the first, but entry {number} is {describe(cost)}."
                )
        try:
            self.costs = stack(costs)
        except ValueError as error:
            raise ValueError(
                "Argument `costs` of Frames must hold at least one cost, and all of one class and size. "
                "Add costs of several classes: Frames(some) + Frames(others)."
            ) from error

    @property
    def of_frames(self) -> bool:
        """True: the cost takes all frames."""
        return True

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """The sum of the costs of all frames."""
        return jnp.sum(self._each(tissue, energy, "__call__"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals of all frames.

        **Raises:**

        - `TypeError` if the costs are not sums of squares.
        """
        return self._each(tissue, energy, "residuals").ravel()

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which residuals of all frames are measurements."""
        return self._each(tissue, energy, "is_measurement").ravel()

    def _each(
        self, tissue: Tissue, energy: AbstractEnergy, method: str
    ) -> Shaped[Array, "frames *n"]:
        """A method of each cost at its frame."""
        n_costs = jax.tree.leaves(eqx.filter(self.costs, eqx.is_array))[0].shape[0]
        if tissue.vertices.ndim != 3 or len(tissue.vertices) != n_costs + 1:
            raise ValueError(
                f"Argument `tissue` of Frames with {n_costs} costs must have {n_costs + 1} frames, the "
                f"initial one included, but its vertices have shape {tissue.vertices.shape}."
            )
        later = jax.tree.map(lambda x: x[1:], tissue)
        evaluate = lambda cost, frame: getattr(cost, method)(frame, energy)
        return eqx.filter_vmap(evaluate)(self.costs, later)
