"""The Laplace approximation of a posterior: its mode and the curvature there."""

from __future__ import annotations

import itertools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vertax._base.announce import announced_jit
from vertax._base.checks import as_key, check_instance
from vertax.bayes._log_posterior import LogPosterior, Outcome, Parameters


class Laplace(eqx.Module):
    r"""Gaussian approximation of a posterior at its mode $\hat z$, in real coordinates $z$.

    $$p(z \mid \text{data}) \approx N(\hat z, \Sigma), \quad
      \Sigma^{-1} = -\frac{\partial^2 \log p}{\partial z^2}, \quad
      \log p(\text{data}) \approx \log p(\text{data}, \hat z) + \tfrac12 \log \det (2 \pi \Sigma)$$

    The real coordinate of a positive parameter is its logarithm, of a parameter on an interval its logit. The
    curvature is a central difference of gradients, so every adjoint serves. The prior of `noise=None` is
    improper: compare evidences with the same kind of noise.

    **Arguments:**

    - `log_posterior`: the density, a [`LogPosterior`][vertax.bayes.LogPosterior].
    - `start`: parameters where the search for the mode begins; by default those of the energy of the problem,
        usually a fit, and the mean of the prior for others.

    **Raises:**

    - `TypeError` for a density that is no `LogPosterior`.
    - `ValueError` if the start lies outside the prior or has no finite density, or the data determine no
        parameter.
    """

    log_posterior: LogPosterior
    mode: Float[Array, " coordinates"]
    """Real coordinates of the mode."""
    factor: Float[Array, "coordinates coordinates"]
    r"""A matrix $L$ with $\Sigma = L L^T$."""
    log_evidence: Float[Array, ""]
    """Log marginal likelihood of the data; NaN if the mode is no maximum."""
    num_gradients: Int[Array, ""]
    """Evaluations of the gradient."""

    def __init__(self, log_posterior: LogPosterior, start: Parameters | None = None):
        check_instance("log_posterior", log_posterior, LogPosterior, "a vertax.bayes.LogPosterior")
        z = log_posterior.start() if start is None else log_posterior.coordinates_of(start)
        first = evaluate(log_posterior, z)
        if not np.isfinite(first.log_density):
            reason = "prior or noise have no finite density there"
            if not first.outcome.converged:
                reason = "the tissue does not reach equilibrium there, or a parameter is not finite"
            raise ValueError(
                f"Argument `start` must have a finite log density, but it is {first.log_density}: {reason}. "
                "Start at the parameters of a fit."
            )
        scale = np.asarray(jnp.std(log_posterior.prior_draws(), axis=0))
        u, density, prior, data, num_gradients = _mode(log_posterior, z, scale)
        if not np.any(np.abs(data) > _UNDETERMINED):
            raise ValueError(
                "The data determine no parameter: the likelihood does not depend on the parameters of "
                "argument `prior`. Look at the cost of the problem."
            )
        values, vectors = np.linalg.eigh(prior + data)
        # In units of the prior its own curvature is about 1. Far less occurs only where the density is
        # convex; there the metric of a sampler must stay finite.
        bounded = np.maximum(values, _LEAST_CURVATURE)
        self.log_posterior, self.mode = log_posterior, z + scale * jnp.asarray(u)
        # (An array: for each other Python integer a sampler would be compiled again.)
        self.num_gradients = jnp.asarray(num_gradients)
        self.factor = jnp.asarray(scale[:, None] * vectors / np.sqrt(bounded))
        volume = 0.5 * np.sum(np.log(2 * np.pi / bounded)) + np.sum(np.log(scale))
        log_evidence = density + volume if values[0] > 0 else np.nan
        self.log_evidence = jnp.asarray(log_evidence, z.dtype)

    def draw(self, key: PRNGKeyArray | int, draws: int) -> dict[str, Array]:
        """Draw parameters: arrays by name with the leading axis of the draws."""
        normal = jax.random.normal(as_key(key), (draws, len(self.mode)), self.mode.dtype)
        return jax.vmap(self.log_posterior.parameters_at)(self.mode + normal @ self.factor.T)


_LEAST_CURVATURE = 0.1
# Step of the central differences, and curvature that counts as 0, in units of the prior.
_STEP = 1e-3
_UNDETERMINED = 1e-6


def _mode(
    log_posterior: LogPosterior, z: Float[Array, " n"], scale: Float[np.ndarray, " n"]
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, int]:
    """The mode z + scale u: u, log density, curvatures of log prior and likelihood, number of gradients."""
    evaluations = itertools.count()

    def at(u: np.ndarray) -> Point:
        next(evaluations)
        return evaluate(log_posterior, z + jnp.asarray(scale * u, z.dtype))

    def value_and_slope(u: np.ndarray) -> tuple[float, np.ndarray]:
        point = at(u)
        return -float(point.log_density), -scale * np.asarray(point.prior_slope + point.data_slope)

    def curvatures(u: np.ndarray) -> list[np.ndarray]:
        """Negative second derivatives of log prior and log likelihood, by central differences."""
        pairs = [(at(u + step), at(u - step)) for step in _STEP * np.eye(len(u))]
        matrices = []
        for name in ("prior_slope", "data_slope"):
            rows = np.stack([np.asarray(getattr(q, name) - getattr(p, name)) for p, q in pairs])
            matrix = rows * scale / (2 * _STEP)
            matrices.append((matrix + matrix.T) / 2)
        return matrices

    # A trust region: a step to a tissue without equilibrium, of density 0, is shortened.
    search = scipy.optimize.minimize(
        value_and_slope,
        np.zeros_like(scale),
        jac=True,
        hess=lambda u: sum(curvatures(u)),
        method="trust-exact",
        options={"gtol": 1e-5, "maxiter": 100},
    )
    if not search.success:
        warnings.warn("The search for the mode of the posterior did not converge.", stacklevel=3)
    prior, data = curvatures(search.x)
    return search.x, -float(search.fun), prior, data, next(evaluations)


class Point(eqx.Module):
    """The log density at a point, its gradients, and the equilibrium."""

    log_density: Float[Array, ""]
    prior_slope: Float[Array, " coordinates"]
    data_slope: Float[Array, " coordinates"]
    outcome: Outcome


@announced_jit
def evaluate(log_posterior: LogPosterior, z: Float[Array, " coordinates"]) -> Point:
    """The log density at real coordinates, with its gradients."""
    (log_prior, _), prior_slope = jax.value_and_grad(log_posterior.log_prior, has_aux=True)(z)
    likelihood = jax.value_and_grad(log_posterior.log_likelihood, has_aux=True)
    (log_likelihood, outcome), data_slope = likelihood(z)
    return Point(log_prior + log_likelihood, prior_slope, data_slope, outcome)
