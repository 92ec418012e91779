"""Gradients of expectations, where what happens is a matter of chance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real


def score_function(
    value: ArrayLike, log_likelihood: ArrayLike, *, baseline: ArrayLike | None = None
) -> Float[Array, ""]:
    r"""The mean of a value over independent runs, whose gradient is that of the expectation.

    What happens in a run, such as which cells die, is drawn with a probability $p_\theta$ that depends on the
    parameters. The gradient of a value $f_\theta$ alone holds that fixed; that of its expectation is

    $$\frac{\mathrm d}{\mathrm d\theta} \mathbb E[f]
      = \mathbb E\left[\frac{\partial f}{\partial\theta}
      + (f - b)\, \frac{\partial \ln p_\theta}{\partial\theta}\right]$$

    with any baseline $b$ that does not depend on the run (Williams 1992, doi:10.1007/BF00992696). Here it is
    the mean of the *other* runs, which takes much of the noise away and leaves no bias.

    ```python
    @eqx.filter_jit
    def mean_size(rate, keys):
        def one(key):
            cycle = vx.growth.GrowAndDivide(0.1, 1.5, death_rate=rate)
            grown = vx.growth.grow(tissue, energy, cycle, times, key=key, throw=False)
            return grown.n_alive[-1] * 1.0, grown.log_likelihood

        return vx.growth.score_function(*jax.vmap(one)(keys))

    slope = jax.grad(mean_size)(0.1, jax.random.split(jax.random.key(0), 100))
    ```

    The noise falls as one over the root of the number of runs, and grows with the number of events in a run.

    **Arguments:**

    - `value`, shape `(runs,)`: the value of each run.
    - `log_likelihood`, shape `(runs,)`: that of each run, as in [`Grown`][vertax.growth.Grown].
    - `baseline`: one for all runs; by default the mean of the other runs.

    **Returns:** the mean of the values.

    **Raises:**

    - `ValueError` for shapes that do not go together, or a single run without a baseline.
    """
    value, likely = as_real("value", value), as_real("log_likelihood", log_likelihood)
    if value.ndim != 1 or value.shape != likely.shape:
        raise ValueError(
            "Arguments `value` and `log_likelihood` must have one entry per run, but have the shapes "
            f"{value.shape} and {likely.shape}."
        )
    n = value.shape[0]
    if baseline is None:
        if n < 2:
            raise ValueError(
                "Argument `baseline` is missing: there is one run alone, and no other to compare it with."
            )
        others = (jnp.sum(value) - value) / (n - 1)
    else:
        others = as_real("baseline", baseline)
    advantage = jax.lax.stop_gradient(value - others)
    return jnp.mean(value + advantage * (likely - jax.lax.stop_gradient(likely)))
