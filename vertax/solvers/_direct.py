"""Symmetric linear systems by one factorisation, for many right-hand sides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

# Columns of the matrix that are computed at a time.
_BATCH = 64


class _Factors(NamedTuple):
    operator: lx.AbstractLinearOperator
    factors: Float[Array, "n n"]
    pivots: Int[Array, " n"]


class Direct(lx.AbstractLinearSolver[Any]):
    r"""A dense factorisation of $A + \delta$, and steps of refinement: for many right-hand sides.

    Where many systems have the same matrix, as in a Jacobian by forward sensitivities, it is set up and
    factorised once. That takes as many products as there are unknowns, time with their cube and memory with
    their square: it is what Levenberg-Marquardt with a thousand parameters needs, and for a single
    right-hand side it is a waste. $\delta$ is $10^{-10}$ (float32: $10^{-4}$) of the size of $A$, so that
    motions which cost no energy, such as those of the whole, do not matter: the solution has a millionth of
    them, if the right-hand side has none.

    Pass it as `ImplicitDifferentiation(linear_solver=vx.solvers.Direct())`.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _Factors:
        """Set up the matrix and factorise it."""
        if not lx.is_symmetric(operator):
            raise ValueError("Argument `operator` must be symmetric, and tagged as such.")
        matrix = as_matrix(operator.mv, operator.in_structure())
        size = jnp.max(jnp.sum(jnp.abs(matrix), axis=1))
        identity = jnp.eye(len(matrix), dtype=matrix.dtype)
        factors, pivots = jax.scipy.linalg.lu_factor(matrix + _share(matrix) * size * identity)
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
        for _ in range(_REFINED):
            x += solve(rhs - product(x))
        left = jnp.sqrt(jnp.sum((rhs - product(x)) ** 2))
        size = jnp.sqrt(jnp.sum(rhs**2))
        solved = left <= 1e3 * _share(zero) * size
        result = lx.RESULTS.where(solved, lx.RESULTS.successful, lx.RESULTS.singular)
        stats = {
            "residual_norm": left / jnp.where(size > 0, size, 1),
            "num_steps": jnp.array(_REFINED),
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

        They hold for a singular one too, as long as its null space stays the same when it changes and the
        right-hand sides of the differentiated systems have no part in it. Otherwise the result is
        `singular`; take [`MINRES`][vertax.MINRES], which differentiates the pseudo-inverse.
        """
        return True


_REFINED = 2


def as_matrix(product: Callable[[PyTree], PyTree], like: PyTree) -> Float[Array, "n n"]:
    """The matrix of a symmetric operator, from its products with vectors of the shapes of `like`."""
    zero, unravel = _flat(like)
    column = lambda v: ravel_pytree(product(unravel(v)))[0]
    # (A smaller last batch would be compiled as well.)
    batches = -(-zero.size // _BATCH)
    unit_vectors = jnp.eye(batches * _BATCH, zero.size, dtype=zero.dtype)
    each = jax.lax.map(jax.vmap(column), unit_vectors.reshape(batches, _BATCH, zero.size))
    return each.reshape(-1, zero.size)[: zero.size]


def _flat(structure: PyTree) -> tuple[Float[Array, " n"], Any]:
    return ravel_pytree(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), structure))


def _share(like: Array) -> float:
    return 1e-10 if like.dtype == jnp.float64 else 1e-4
