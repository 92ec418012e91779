"""Uncertainty of fitted parameters: the Gauss-Newton (Laplace) approximation."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checks import check_number
from vertax._base.tracing import is_concrete, traced
from vertax.energies import AbstractEnergy
from vertax.fitting._history import Fit
from vertax.fitting._inverse import Energy, InverseProblem
from vertax.mesh import Tissue


class Uncertainty(eqx.Module):
    """Uncertainty of the fitted parameters, from [`uncertainty`][vertax.uncertainty]."""

    deviation: AbstractEnergy
    """The energy with the standard deviation of each fitted parameter in its place; other leaves are None."""
    covariance: Float[Array, "parameters parameters"]
    """Covariance of all fitted parameters, flattened in the order of `jax.tree.leaves`. Directions of
    infinite variance are left out."""
    directions: Float[Array, "combinations parameters"]
    """Eigenvectors (orthonormal rows), from the least to the best determined combination of parameters."""
    deviations: Float[Array, " combinations"]
    """Standard deviation along each direction; for a direction that the data do not determine that of the
    prior, infinite without a prior."""
    noise: Float[Array, ""]
    """Standard deviation of the noise of a residual, estimated from the residuals of the fit."""


def uncertainty(
    problem: InverseProblem[Energy],
    fit: Fit[Energy],
    *,
    prior: float | None = None,
    n_independent: float | int | None = None,
) -> Uncertainty:
    r"""Uncertainty of the fitted parameters from the curvature of the cost (Laplace approximation).

    With residuals $r(\theta)$ of a least-squares cost, their Jacobian $J$ through the equilibrium, and
    $\sigma^2 = r^T r / (M - K)$ of $M$ residuals and $K$ parameters (without those of spare slots),

    $$\mathrm{Cov}(\theta) = \bigl(J^T J / \sigma^2 + I / s^2\bigr)^{-1}$$

    with the standard deviation $s$ of a Gaussian prior, if given. With `fit_position` the position is
    marginalised. Valid for independent residuals that are small enough for a linear response of the
    equilibrium.

    **Arguments:**

    - `problem`: the inverse problem, with a sum of squares as its cost.
    - `fit`: its fit; for a batch, one member.
    - `prior`: standard deviation $s$ of the prior, in units of the parameters; it bounds the variance along
        directions that the data do not determine.
    - `n_independent`: number of independent residuals, if residuals are correlated (e.g. neighbouring pixels
        with a systematic misfit); by default all.

    **Returns:** an [`Uncertainty`][vertax.Uncertainty].

    **Raises:**

    - `TypeError` if the cost is not a sum of squares.
    - `ValueError` for a prior that is not positive, a batch, or too few independent residuals.
    """
    if prior is not None:
        check_number("prior", prior, above=0)
    if n_independent is not None:
        check_number("n_independent", n_independent, above=0)
    if problem.tissue.vertices.ndim != 2 or fit.tissue.vertices.ndim != 2:
        raise ValueError(
            "Arguments `problem` and `fit` must be single, but are a batch. Take a member of each: "
            "vertax.fitting.member(fit, 0)."
        )
    dtype = problem.tissue.vertices.dtype
    parameters, constants = traced(eqx.partition(fit.energy, problem.trainable), dtype)
    problem = problem.with_array_numbers(dtype)
    flat, unravel = jfu.ravel_pytree(parameters)
    shift = jnp.zeros(2, flat.dtype) if problem.fit_position else None
    tissue = traced(problem.next_start(fit.tissue), dtype)
    primal = problem.primal(eqx.combine(parameters, constants), tissue, shift)
    gram, squares, n_residuals = _gram(problem, primal, tissue, flat, unravel, constants, shift)
    n_free = n_residuals if n_independent is None else n_independent
    # No residual depends on a parameter of a spare slot.
    n_fitted = len(gram) - jnp.sum(jnp.diag(gram)[: len(flat)] == 0)
    if is_concrete(n_fitted) and not n_free > n_fitted:
        raise ValueError(
            f"There must be more independent residuals than parameters, but there are {float(n_free):g} "
            f"residuals and {n_fitted} parameters. Fit fewer parameters, or raise `n_independent`."
        )
    variance = squares / (n_residuals * (1 - n_fitted / n_free))
    # Marginalise the position: the Schur complement of its block of JᵀJ. The pseudo-inverse covers costs that
    # do not depend on the position, for which the block is 0.
    information, cross, position = (
        gram[: len(flat), : len(flat)],
        gram[: len(flat), len(flat) :],
        gram[len(flat) :, len(flat) :],
    )
    if shift is not None:
        information = information - cross @ jnp.linalg.pinv(position, hermitian=True) @ cross.T
    values, vectors = jnp.linalg.eigh((information + information.T) / 2)
    # Directions that the data do not determine, judged before the prior is added. The Jacobian through the
    # equilibrium has a relative error of about 1e-6 (in float32 1e-3), so eigenvalues of JᵀJ below 1e-10 (in
    # float32 1e-5) of the largest are 0.
    rounding = float(jnp.finfo(dtype).eps)
    undetermined = (values <= max(1e-10, 100 * rounding) * values[-1]) | (values <= 0)
    # With n_free independent of n_residuals residuals, JᵀJ counts each independent one n_residuals / n_free
    # times.
    spread = variance * n_residuals / n_free
    prior_precision = 0.0 if prior is None else spread * prior**-2
    determined_variance = jnp.where(
        undetermined, 0, spread / (jnp.where(undetermined, 1, values) + prior_precision)
    )
    undetermined_variance = jnp.where(undetermined, jnp.inf if prior is None else prior**2, 0)
    # The covariance leaves out directions of infinite variance.
    inverse = determined_variance + jnp.where(
        jnp.isfinite(undetermined_variance), undetermined_variance, 0
    )
    covariance = (vectors * inverse) @ vectors.T
    share = jnp.sum(jnp.where(jnp.isinf(undetermined_variance), vectors**2, 0), axis=1)
    infinite = share > max(1e-9, 10 * rounding)
    deviation = jnp.where(infinite, jnp.inf, jnp.sqrt(jnp.diag(covariance)))
    deviations = jnp.sqrt(determined_variance + undetermined_variance)
    return Uncertainty(unravel(deviation), covariance, vectors.T, deviations, jnp.sqrt(variance))


@announced_jit
def _gram(
    problem: InverseProblem,
    primal: PyTree,
    tissue: Tissue,
    flat: Float[Array, " parameters"],
    unravel: Callable[[Array], PyTree[Array]],
    constants: PyTree,
    shift: Float[Array, "2"] | None,
) -> tuple[Float[Array, "n n"], Float[Array, ""], Int[Array, ""]]:
    """JᵀJ, rᵀr and the number of residuals that are measurements."""
    n = len(flat)

    def residuals(x: Float[Array, " n"]) -> tuple[Float[Array, " residuals"], Int[Array, ""]]:
        energy = eqx.combine(unravel(x[:n]), constants)
        position = None if shift is None else x[n:]
        values, equilibrium, _ = problem.residuals(energy, tissue, position, primal)
        return values, jnp.sum(problem.is_measurement(energy, equilibrium))

    at = flat if shift is None else jnp.concatenate([flat, shift])
    values, forward, n_residuals = jax.linearize(residuals, at, has_aux=True)
    backward = jax.linear_transpose(forward, at)
    # One column at a time: an image has many residuals.
    gram = jax.lax.map(lambda e: backward(forward(e))[0], jnp.eye(len(at), dtype=at.dtype))
    return gram, jnp.sum(values**2), n_residuals
