"""Symmetric linear systems by one dense factorisation, for many right-hand sides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

# Number of columns of the matrix per batch of products.
_BATCH = 64


class _Factors(NamedTuple):
    operator: lx.AbstractLinearOperator
    factors: Float[Array, "n n"]
    pivots: Int[Array, " n"]


class Direct(lx.AbstractLinearSolver[Any]):
    r"""LU factorisation of $A + \delta I$ with iterative refinement, for many right-hand sides.

    The matrix is set up and factorised once, and used for all right-hand sides, such as those of a Jacobian
    by forward sensitivities. Cost for $n$ unknowns: $n$ products with $A$, time $O(n^3)$, memory $O(n^2)$.
    This pays for Levenberg-Marquardt with a thousand parameters, but not for a single right-hand side.

    The shift $\delta = 10^{-10} \|A\|_\infty$ (float32: $10^{-4} \|A\|_\infty$) makes the matrix regular if
    $A$ has null vectors, such as rigid motions. If the right-hand side has no component along them, their
    relative weight in the solution is about $10^{-6}$.

    Pass it as `ImplicitDifferentiation(linear_solver=vx.solvers.Direct())`.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _Factors:
        """Set up the matrix and factorise it."""
        if not lx.is_symmetric(operator):
            raise ValueError("Argument `operator` must be symmetric, and tagged as such.")
        matrix = as_matrix(operator.mv, operator.in_structure())
        size = jnp.max(jnp.sum(jnp.abs(matrix), axis=1))
        identity = jnp.eye(len(matrix), dtype=matrix.dtype)
        factors, pivots = jax.scipy.linalg.lu_factor(
            matrix + _relative_shift(matrix) * size * identity
        )
        return _Factors(operator, factors, pivots)

    def compute(
        self, state: _Factors, vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        """Solve for one right-hand side, with two steps of refinement."""
        zero, unravel = _flat(state.operator.in_structure())
        product = lambda v: ravel_pytree(state.operator.mv(unravel(v)))[0]
        solve = lambda r: jax.scipy.linalg.lu_solve((state.factors, state.pivots), r)
        rhs = ravel_pytree(vector)[0]
        x = solve(rhs)
        for _ in range(_REFINEMENT_STEPS):
            x += solve(rhs - product(x))
        residual = jnp.sqrt(jnp.sum((rhs - product(x)) ** 2))
        size = jnp.sqrt(jnp.sum(rhs**2))
        solved = residual <= 1e3 * _relative_shift(zero) * size
        result = lx.RESULTS.where(solved, lx.RESULTS.successful, lx.RESULTS.singular)
        stats = {
            "residual_norm": residual / jnp.where(size > 0, size, 1),
            "num_steps": jnp.array(_REFINEMENT_STEPS),
        }
        return unravel(x), result, stats

    def transpose(
        self, state: _Factors, options: dict[str, Any]
    ) -> tuple[_Factors, dict[str, Any]]:
        """A symmetric matrix is its own transpose."""
        return state, options

    def conj(self, state: _Factors, options: dict[str, Any]) -> tuple[_Factors, dict[str, Any]]:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """True: derivatives of the solution are those of a nonsingular matrix.

        For a singular matrix they hold if its null space is constant and the right-hand sides of the
        differentiated systems have no component in it. Otherwise the result is `singular`; use
        [`MINRES`][vertax.MINRES], which differentiates the pseudo-inverse.
        """
        return True


_REFINEMENT_STEPS = 2


def as_matrix(product: Callable[[PyTree], PyTree], like: PyTree) -> Float[Array, "n n"]:
    """The matrix of a symmetric operator, from products with unit vectors of the shapes of `like`."""
    zero, unravel = _flat(like)
    column = lambda v: ravel_pytree(product(unravel(v)))[0]
    # (Padded to full batches: a smaller last batch would be compiled separately.)
    batches = -(-zero.size // _BATCH)
    unit_vectors = jnp.eye(batches * _BATCH, zero.size, dtype=zero.dtype)
    each = jax.lax.map(jax.vmap(column), unit_vectors.reshape(batches, _BATCH, zero.size))
    return each.reshape(-1, zero.size)[: zero.size]


def _flat(structure: PyTree) -> tuple[Float[Array, " n"], Any]:
    return ravel_pytree(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), structure))


def _relative_shift(like: Array) -> float:
    return 1e-10 if like.dtype == jnp.float64 else 1e-4
