"""Adaptive time steps from an estimate of the local error."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.checks import check_integer, check_number
from vertax._base.tracing import frozen
from vertax.mesh import Tissue

# The PI controller (Söderlind 2002, doi:10.1023/A:1021160023092): with the errors ε_n in units of the
# tolerance, dt_{n+1} = dt_n · safety · ε_n^(-0.7/(p+1)) · ε_{n-1}^(0.4/(p+1)), and the factor is clipped.
_INTEGRAL, _PROPORTIONAL, _SAFETY, _MIN_FACTOR, _MAX_FACTOR = 0.7, 0.4, 0.9, 0.2, 5.0


class PIController(eqx.Module):
    r"""Adaptive time steps: the largest that an error tolerance allows.

    ```python
    control = vx.dynamics.PIController(1e-4)
    vx.evolve(tissue, energy, friction, [0.0, 1.0, 10.0], stepsize_controller=control)
    ```

    Step doubling with a PI controller (Hairer & Wanner, Solving Ordinary Differential Equations II, IV.2):

    1. Take one step $\Delta t$ to $x_1$, and two steps $\Delta t / 2$ to $x_2$.
    2. Estimate the error of $x_2$ by $\max |x_2 - x_1| / (2^p - 1)$ for a method of order $p$, relative to
        the size of a cell; of concentrations relative to the largest one.
    3. If the error exceeds the tolerance, or a relaxation does not converge, reject the step and repeat it
        with a smaller $\Delta t$. Otherwise continue from $x_2$.
    4. Compute the next $\Delta t$ from the last two errors.

    The global error scales about as the tolerance to the power $p / (p + 1)$.

    **Arguments:**

    - `tolerance`: of the error of one step, in units of the size of a cell.
    - `first_step`: the first time step; by default a tenth of the time to the first frame.
    - `max_steps`: maximum number of steps per frame, including rejected ones. The memory of a gradient
        grows with it.

    **Raises:**

    - `ValueError` for numbers that are not positive.
    """

    tolerance: float | Float[Array, ""] = 1e-3
    first_step: float | Float[Array, ""] | None = None
    max_steps: int = eqx.field(default=100, static=True)

    def __check_init__(self):
        check_number("tolerance", self.tolerance, above=0)
        if self.first_step is not None:
            check_number("first_step", self.first_step, above=0)
        check_integer("max_steps", self.max_steps, at_least=1)

    def begin(self, times: Float[Array, " times"]) -> Float[Array, ""]:
        """The first time step."""
        first = 0.1 * (times[1] - times[0]) if self.first_step is None else self.first_step
        return jnp.asarray(first, times.dtype)

    def error(
        self,
        halves: Tissue,
        full: Tissue,
        order: int,
        records: tuple[PyTree[Array], PyTree[Array]] = (None, None),
    ) -> Float[Array, ""]:
        """The error estimate of two half steps, in units of the tolerance.

        The error of the `records` of an activity is relative to the largest entry of each row.
        """
        difference = jax.tree.map(jnp.subtract, *frozen((halves.configuration, full.configuration)))
        error = optx.max_norm(difference) / frozen(halves.cell_size)
        for one, other in zip(*map(jax.tree.leaves, frozen(records)), strict=True):
            scale = jnp.max(jnp.abs(one), axis=-1, keepdims=True)
            relative = jnp.abs(one - other) / jnp.where(scale > 0, scale, 1)
            error = jnp.maximum(error, jnp.max(relative))
        return error / (self.tolerance * (2**order - 1))

    def next_step(
        self,
        dt: Float[Array, ""],
        error: Float[Array, ""],
        previous_error: Float[Array, ""],
        converged: Bool[Array, ""],
        order: int,
    ) -> Float[Array, ""]:
        """The next time step.

        **Arguments:**

        - `dt`: the last time step.
        - `error`: its error, in units of the tolerance.
        - `previous_error`: the error of the step before it.
        - `converged`: whether the relaxations of the last step converged.
        - `order`: the order of the method.
        """
        floor = 1e-6  # smaller errors do not enlarge the step further, and 1 / error stays finite
        factor = _SAFETY * jnp.maximum(error, floor) ** (-_INTEGRAL / (order + 1))
        factor = factor * jnp.maximum(previous_error, floor) ** (_PROPORTIONAL / (order + 1))
        # After a rejection use the last error only, and do not enlarge the step.
        rejected = jnp.minimum(_SAFETY * jnp.maximum(error, floor) ** (-1 / (order + 1)), _SAFETY)
        factor = jnp.where(error <= 1, factor, rejected)
        factor = jnp.where(converged & jnp.isfinite(error), factor, _MIN_FACTOR)
        return dt * jnp.clip(factor, _MIN_FACTOR, _MAX_FACTOR)
