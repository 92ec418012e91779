"""The marginal likelihood of a model by sequential Monte Carlo."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from blackjax.mcmc import hmc
from blackjax.smc import adaptive_tempered, resampling
from blackjax.smc.tempered import TemperedSMCState
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PRNGKeyArray

from vertax._base.announce import announce_compilations, announced_jit
from vertax._base.checks import as_key, check_instance, check_integer
from vertax.bayes._laplace import Laplace

# Standard deviation of the first particles in units of the Laplace approximation: wider, because weights
# cannot correct tails without particles.
_WIDTH = 1.2
# Log weight in place of -∞, for tissues without equilibrium: a product with 0 must be 0.
_LEAST_LOG_WEIGHT = -1e10
_MAX_TEMPERATURES = 200


@announce_compilations("an evidence")
def evidence(
    laplace: Laplace, key: PRNGKeyArray | int, *, particles: int = 200, moves: int = 3
) -> Float[Array, ""]:
    r"""Log marginal likelihood $\log p(\text{data})$ by adaptive tempered sequential Monte Carlo.

    Particles move from a Gaussian $q$, the Laplace approximation widened by 1.2, to the posterior along
    $q^{1 - \lambda}\, p(\text{data}, z)^\lambda$, $0 \le \lambda \le 1$, by Hamiltonian Monte Carlo; each
    increase of $\lambda$ halves the effective number of particles. The difference of two models is the
    logarithm of their Bayes factor. Repeat with another key for its error. Del Moral, Doucet and Jasra 2006,
    doi:10.1111/j.1467-9868.2006.00553.x; sampler of BlackJAX.

    **Arguments:**

    - `laplace`: the approximation; for a Gaussian posterior the result is its `log_evidence`.
    - `key`: a random key or a seed.
    - `particles`: number of particles.
    - `moves`: moves of each particle at each $\lambda$.

    **Returns:** the log evidence, with the constants of prior and noise.

    **Raises:**

    - `TypeError` for an argument that is no `Laplace`.
    - `ValueError` for fewer than 2 particles or 1 move.
    - `RuntimeError` if the particles do not reach the posterior.
    """
    check_instance("laplace", laplace, Laplace, "a vertax.bayes.Laplace")
    check_integer("particles", particles, at_least=2)
    check_integer("moves", moves, at_least=1)
    keys = jax.random.split(as_key(key), _MAX_TEMPERATURES + 1)
    mode = laplace.mode
    first = _WIDTH * jax.random.normal(keys[0], (particles, len(mode)), mode.dtype)
    weights = jnp.full(particles, 1 / particles, mode.dtype)
    state = TemperedSMCState(first, weights, jnp.zeros((), mode.dtype))
    log_evidence = jnp.linalg.slogdet(laplace.factor)[1]
    for step_key in keys[1:]:
        state, increment = _step(laplace, state, step_key, moves)
        log_evidence += increment
        if state.tempering_param >= 1:
            return log_evidence
    raise RuntimeError(
        f"The particles did not reach the posterior in {_MAX_TEMPERATURES} steps (λ = "
        f"{float(state.tempering_param):.2g}). Raise `particles` or `moves`."
    )


@announced_jit
def _step(
    laplace: Laplace, state: TemperedSMCState, key: PRNGKeyArray, moves: int
) -> tuple[TemperedSMCState, Float[Array, ""]]:
    """The next λ, and the increment of the log evidence."""
    posterior, size = laplace.log_posterior, len(laplace.mode)

    def log_reference(u: Array) -> Array:
        return jnp.sum(norm.logpdf(u, scale=_WIDTH))

    def log_weight(u: Array) -> Array:
        z = laplace.mode + laplace.factor @ u
        return jnp.maximum(posterior.log_density(z) - log_reference(u), _LEAST_LOG_WEIGHT)

    kernel = adaptive_tempered.build_kernel(
        log_reference, log_weight, hmc.build_kernel(), hmc.init, resampling.systematic, 0.5
    )
    # The best step of Hamiltonian Monte Carlo is proportional to d^(-1/4); a quarter period decorrelates.
    step_size = size**-0.25
    settings = {
        "step_size": jnp.array([step_size]),
        "inverse_mass_matrix": jnp.ones((1, size)),
        "num_integration_steps": jnp.array([math.ceil(math.pi / 2 / step_size)]),
    }
    state, info = kernel(key, state, moves, settings)
    return state, jnp.asarray(info.log_likelihood_increment)
