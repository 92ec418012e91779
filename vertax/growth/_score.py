"""Score-function gradients of expectations over random events."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real


def score_function(
    value: ArrayLike, log_likelihood: ArrayLike, *, baseline: ArrayLike | None = None
) -> Float[Array, ""]:
    r"""Mean of a value over independent runs, with the gradient of the expectation (score function).

    The events of a run, e.g. which cells die, are drawn with a probability $p_\theta$ that depends on the
    parameters. The gradient of a value $f_\theta$ holds the events fixed; that of its expectation is

    $$\frac{\mathrm d}{\mathrm d\theta} \mathbb E[f]
      = \mathbb E\left[\frac{\partial f}{\partial\theta}
      + (f - b)\, \frac{\partial \ln p_\theta}{\partial\theta}\right]$$

    with any baseline $b$ that does not depend on the run (Williams 1992, doi:10.1007/BF00992696). By default
    it is the mean of the *other* runs, which reduces the variance without bias.

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

    The standard error is proportional to $1/\sqrt{n}$ for $n$ runs, and grows with the number of events per
    run.

    **Arguments:**

    - `value`, shape `(runs,)`: the value of each run.
    - `log_likelihood`, shape `(runs,)`: that of the events of each run, see [`Grown`][vertax.growth.Grown].
    - `baseline`: $b$, the same for all runs; by default the mean of the other runs.

    **Returns:** the mean of the values.

    **Raises:**

    - `ValueError` for different shapes, or a single run without a baseline.
    """
    value, log_p = as_real("value", value), as_real("log_likelihood", log_likelihood)
    if value.ndim != 1 or value.shape != log_p.shape:
        raise ValueError(
            "Arguments `value` and `log_likelihood` must have one entry per run, but have the shapes "
            f"{value.shape} and {log_p.shape}."
        )
    n = value.shape[0]
    if baseline is None:
        if n < 2:
            raise ValueError(
                "Argument `baseline` must be given for a single run, but is None: there are no other runs "
                "to average."
            )
        b = (jnp.sum(value) - value) / (n - 1)
    else:
        b = as_real("baseline", baseline)
    advantage = jax.lax.stop_gradient(value - b)
    return jnp.mean(value + advantage * (log_p - jax.lax.stop_gradient(log_p)))
