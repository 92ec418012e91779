"""How well data determine the parameters: the Gauss-Newton (Laplace) approximation at a fit."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checks import check_number
from vertax._base.tracing import traced
from vertax.energies import AbstractEnergy
from vertax.fitting._history import Fit
from vertax.fitting._inverse import InverseProblem
from vertax.mesh import Tissue


class Uncertainty(eqx.Module):
    """What the data say, and do not say, of the parameters of a fit."""

    deviation: AbstractEnergy
    """Standard deviation of each fitted parameter, in its place in the energy; others are None."""
    covariance: Float[Array, "parameters parameters"]
    """Covariance of all fitted parameters, flattened in the order of `jax.tree.leaves`; what neither the
    data nor a prior determine is left out of it."""
    directions: Float[Array, "combinations parameters"]
    """Combinations of parameters (orthonormal rows), from the worst determined to the best."""
    deviations: Float[Array, " combinations"]
    """Standard deviation along each combination; where the data say nothing that of the prior, infinite
    without one."""
    noise: Float[Array, ""]
    """Standard deviation of the noise of a residual, estimated from what the fit left over."""


def uncertainty(
    problem: InverseProblem,
    fit: Fit,
    *,
    prior: float | None = None,
    n_independent: float | int | None = None,
) -> Uncertainty:
    r"""Uncertainty of the fitted parameters from the curvature of the cost (Laplace approximation).

    With residuals $r(\theta)$ of a least-squares cost, their Jacobian $J$ through the equilibrium, and
    $\sigma^2 = r^T r / (M - K)$ of $M$ residuals and $K$ parameters,

    $$\mathrm{Cov}(\theta) = \bigl(J^T J / \sigma^2 + I / s^2\bigr)^{-1}$$

    with the standard deviation $s$ of a Gaussian prior, if there is one. A fitted position is fitted
    along, and its uncertainty included. It holds where residuals are independent and small enough
    that the equilibrium responds linearly.

    **Arguments:**

    - `problem`: the inverse problem, with a sum of squares as its cost.
    - `fit`: its outcome; of a batch, one member.
    - `prior`: standard deviation of the parameters before the data were seen, in their units; it keeps
        finite what the data do not determine.
    - `n_independent`: number of independent residuals, if neighbours are correlated (pixels of an image
        whose misfit is a structure and not noise); by default all.

    **Returns:** an [`Uncertainty`][vertax.Uncertainty].

    **Raises:**

    - `TypeError` if the cost is no sum of squares.
    - `ValueError` for a prior that is not positive, for a batch, or if there are not more independent
        residuals than parameters.
    """
    if prior is not None:
        check_number("prior", prior, above=0)
    if n_independent is not None:
        check_number("n_independent", n_independent, above=0)
    if problem.tissue.vertices.ndim != 2 or fit.tissue.vertices.ndim != 2:
        raise ValueError(
            "Arguments `problem` and `fit` must be single ones, but are a batch. Take a member of each: "
            "jax.tree.map(lambda x: x[0] if equinox.is_array(x) else x, fit)."
        )
    dtype = problem.tissue.vertices.dtype
    parameters, constants = traced(eqx.partition(fit.energy, problem.trainable), dtype)
    problem = problem.as_data(dtype)
    flat, unravel = jfu.ravel_pytree(parameters)
    shift = jnp.zeros(2, flat.dtype) if problem.fit_position else None
    tissue = traced(problem.onward(fit.tissue), dtype)
    primal = problem.primal(eqx.combine(parameters, constants), tissue, shift)
    gram, squares, n_residuals = _gram(problem, primal, tissue, flat, unravel, constants, shift)
    n_free = n_residuals if n_independent is None else n_independent
    n_fitted = len(gram)
    if not n_free > n_fitted:
        raise ValueError(
            f"There must be more independent residuals than parameters, but there are {n_free:g} of "
            f"them and {n_fitted} parameters. Fit fewer, or raise `n_independent`."
        )
    variance = squares / (n_residuals * (1 - n_fitted / n_free))
    # Where the tissue lies is fitted too, and known only so well. (A cost that does not see it leaves
    # zeros, which the pseudo-inverse passes by.)
    known, crossed, position = (
        gram[: len(flat), : len(flat)],
        gram[: len(flat), len(flat) :],
        gram[len(flat) :, len(flat) :],
    )
    if shift is not None:
        known = known - crossed @ jnp.linalg.pinv(position, hermitian=True) @ crossed.T
    values, vectors = jnp.linalg.eigh((known + known.T) / 2)
    # What the data do not see is asked of the data alone: a prior adds the same to all directions.
    # Slopes through the equilibrium are known to about 1e-6, their squares to the square of that.
    unknown = (values <= 1e-10 * values[-1]) | (values <= 0)
    # So many residuals speak for themselves; the others repeat what they say.
    spread = variance * n_residuals / n_free
    rest = 0.0 if prior is None else spread * prior**-2
    seen = jnp.where(unknown, 0, spread / (jnp.where(unknown, 1, values) + rest))
    unseen = jnp.where(unknown, jnp.inf if prior is None else prior**2, 0)
    # The covariance has no place for infinity.
    inverse = seen + jnp.where(jnp.isfinite(unseen), unseen, 0)
    covariance = (vectors * inverse) @ vectors.T
    lost = jnp.sum(jnp.where(jnp.isinf(unseen), vectors**2, 0), axis=1) > 1e-9
    deviation = jnp.where(lost, jnp.inf, jnp.sqrt(jnp.diag(covariance)))
    along = jnp.sqrt(seen + unseen)
    return Uncertainty(unravel(deviation), covariance, vectors.T, along, jnp.sqrt(variance))


@announced_jit
def _gram(
    problem: InverseProblem,
    primal: PyTree,
    tissue: Tissue,
    flat: Float[Array, " parameters"],
    unravel: Callable[[Array], PyTree[Array]],
    constants: PyTree,
    shift: Float[Array, "2"] | None,
) -> tuple[Float[Array, "n n"], Float[Array, ""], int]:
    """JᵀJ, rᵀr and the number of residuals."""
    n = len(flat)

    def residuals(x: Float[Array, " n"]) -> Float[Array, " residuals"]:
        energy = eqx.combine(unravel(x[:n]), constants)
        return problem.residuals(energy, tissue, None if shift is None else x[n:], primal)[0]

    at = flat if shift is None else jnp.concatenate([flat, shift])
    values, forward = jax.linearize(residuals, at)
    backward = jax.linear_transpose(forward, at)
    # One column at a time: an image has many residuals.
    gram = jax.lax.map(lambda e: backward(forward(e))[0], jnp.eye(len(at), dtype=at.dtype))
    return gram, jnp.sum(values**2), len(values)
