"""Steps in time whose length follows an estimate of their error."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from vertax._base.checks import check_integer, check_number
from vertax.adjoints._adjoint import frozen
from vertax.energies._units import cell_size
from vertax.mesh import Tissue

# Of a controller with a proportional and an integral part (Söderlind 2002, doi:10.1023/A:1021160023092): how
# the next step follows the last error and the one before, how far below the tolerance it aims, and by how
# much a step may change.
_INTEGRAL, _PROPORTIONAL, _SAFETY, _LEAST, _MOST = 0.7, 0.4, 0.9, 0.2, 5.0


class StepControl(eqx.Module):
    r"""Steps in time are as long as a tolerance of their error allows.

    ```python
    control = vx.dynamics.StepControl(1e-4)
    vx.evolve(tissue, energy, friction, [0.0, 1.0, 10.0], control=control)
    ```

    Each step is done once as a whole and once in two halves. The halves are what counts, and their distance
    from the whole, over $2^p - 1$ for a method of order $p$, is the estimate of their error: the farthest
    that any vertex is off, in units of the size of a cell. Where it exceeds the tolerance, or a part of the
    step comes to no end, the step is done again, shorter. The next one follows the last two errors. (Step
    doubling and a PI controller, as in Hairer & Wanner, Solving Ordinary Differential Equations II, IV.2.)
    The error at the end, after many steps, goes about as the tolerance to the power $p / (p + 1)$.

    **Arguments:**

    - `tolerance`: of the error of one step, in units of the size of a cell.
    - `first`: length of the first step in time; by default a tenth of the way to the first frame.
    - `most`: most steps from one frame to the next, with those that are done again. The memory of a gradient
        grows with it.

    **Raises:**

    - `ValueError` for numbers that are not positive.
    """

    tolerance: float | Float[Array, ""] = 1e-3
    first: float | Float[Array, ""] | None = None
    most: int = eqx.field(default=100, static=True)

    def __check_init__(self):
        check_number("tolerance", self.tolerance, above=0)
        if self.first is not None:
            check_number("first", self.first, above=0)
        check_integer("most", self.most, at_least=1)

    def begin(self, times: Float[Array, " times"]) -> Float[Array, ""]:
        """The length of the first step."""
        first = 0.1 * (times[1] - times[0]) if self.first is None else self.first
        return jnp.asarray(first, times.dtype)

    def error(self, fine: Tissue, coarse: Tissue, order: int) -> Float[Array, ""]:
        """The error of two half steps, in units of the tolerance."""
        apart = jax.tree.map(jnp.subtract, *frozen((fine.configuration, coarse.configuration)))
        size = frozen(cell_size(fine)) * self.tolerance
        return optx.max_norm(apart) / (size * (2**order - 1))

    def next_step(
        self,
        dt: Float[Array, ""],
        error: Float[Array, ""],
        last: Float[Array, ""],
        sound: Bool[Array, ""],
        order: int,
    ) -> Float[Array, ""]:
        """The length of the next step.

        **Arguments:**

        - `dt`: that of the step before it.
        - `error`: of that, in units of the tolerance.
        - `last`: of the one before that.
        - `sound`: whether it came to an end.
        - `order`: of the method.
        """
        tiny = 1e-6  # as exact as this is exact enough, and finite to the power of -1
        by = _SAFETY * jnp.maximum(error, tiny) ** (-_INTEGRAL / (order + 1))
        by = by * jnp.maximum(last, tiny) ** (_PROPORTIONAL / (order + 1))
        # After a refusal the history says nothing, and a step must not grow.
        refused = jnp.minimum(_SAFETY * jnp.maximum(error, tiny) ** (-1 / (order + 1)), _SAFETY)
        by = jnp.where(error <= 1, by, refused)
        by = jnp.where(sound & jnp.isfinite(error), by, _LEAST)
        return dt * jnp.clip(by, _LEAST, _MOST)
