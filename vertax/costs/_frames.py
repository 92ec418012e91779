"""Costs of a tissue on its way."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vertax._base.batch import stack
from vertax._base.checks import describe
from vertax.costs._cost import AbstractCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Frames(AbstractCost):
    r"""What is wanted of each frame of a movement: the sum $\sum_k C_k(x(t_k))$.

    ```python
    cost = vx.costs.Frames([vx.costs.VertexDistance(tissue) for tissue in seen])
    problem = vx.InverseProblem(seen_first, energy, cost, response=vx.Evolution(friction, times))
    ```

    It is a sum of squares if they are, so that least-squares solvers and
    [`uncertainty`][vertax.uncertainty] apply. A cost of your own that sees all frames at once has a property
    `of_frames` that is True; it is called with a tissue that has a leading axis of times.

    **Arguments:**

    - `costs`: one for each of the times after the first, all of one kind; of the first the tissue is given.

    **Raises:**

    - `TypeError` for what is no cost.
    - `ValueError` for no costs, or costs that are not of one kind and size.
    """

    costs: AbstractCost
    """All as one, with a leading axis."""

    def __init__(self, costs: Sequence[AbstractCost]):
        costs = list(costs)
        for number, cost in enumerate(costs):
            if not isinstance(cost, AbstractCost) or cost.of_frames:
                raise TypeError(
                    "Argument `costs` of Frames must hold costs of single tissues, one for each time after "
                    f"the first, but number {number} is {describe(cost)}."
                )
        try:
            self.costs = stack(costs)
        except ValueError as error:
            raise ValueError(
                "Argument `costs` of Frames must hold at least one cost, and all of one kind and size. "
                "Add up costs of several kinds: Frames(some) + Frames(others)."
            ) from error

    @property
    def of_frames(self) -> bool:
        """It sees all frames."""
        return True

    def __call__(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, ""]:
        """The sum of the costs of all frames."""
        return jnp.sum(self._each(tissue, energy, "__call__"))

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The residuals of all frames.

        **Raises:**

        - `TypeError` if the costs are no sums of squares.
        """
        return self._each(tissue, energy, "residuals").ravel()

    def _each(self, tissue: Tissue, energy: AbstractEnergy, what: str) -> Float[Array, "frames *n"]:
        n_costs = jax.tree.leaves(eqx.filter(self.costs, eqx.is_array))[0].shape[0]
        if tissue.vertices.ndim != 3 or len(tissue.vertices) != n_costs + 1:
            raise ValueError(
                f"Frames holds {n_costs} costs, so it must see {n_costs + 1} frames, that of the start "
                f"included, but vertices have the shape {tissue.vertices.shape}."
            )
        later = jax.tree.map(lambda x: x[1:], tissue)
        of_one = lambda cost, frame: getattr(cost, what)(frame, energy)
        return eqx.filter_vmap(of_one)(self.costs, later)
