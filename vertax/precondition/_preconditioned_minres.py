"""MINRES for the Hessian of a tissue, with a preconditioner."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.rows import point_of, table_of
from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import zeros_of
from vertax.precondition._sum import Preconditioner, TissueInverse
from vertax.solvers import MINRES


class _Attempt(NamedTuple):
    """The result of one solve, with the preconditioner or, the second time, without."""

    solution: PyTree[Array]
    result: lx.RESULTS
    stats: dict[str, Array]
    preconditioned: Bool[Array, ""]
    again: Bool[Array, ""]


class _State(NamedTuple):
    """What is computed once for an operator."""

    linear: Any
    inverse: TissueInverse
    factors: PyTree[Array]


class PreconditionedMINRES(lx.AbstractLinearSolver[_State]):
    """MINRES for the Hessian of a tissue, with a `Preconditioner`.

    If the system has no solution (the right-hand side has a component along zero modes), the result would
    depend on the preconditioner: such a system is solved again without.
    """

    plain: MINRES
    preconditioner: Preconditioner
    stiffness: Float[Array, ""]

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _State:
        linear = self.plain.init(operator, options)
        like = zeros_of(operator.in_structure())
        inverse = self.preconditioner.inverse(linear.mv, like, self.stiffness, jnp.array(True))
        n_rows = sum(x.shape[0] if x.ndim else 1 for x in jax.tree.leaves(like))
        return _State(linear, inverse, inverse.factors(jnp.zeros(n_rows, self.stiffness.dtype)))

    def compute(
        self, state: _State, vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        return sequential_vmap_on_cpu(_solve)(self, state, vector, options)

    def transpose(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        return state, options

    def conj(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return self.plain.assume_full_rank()


def _solve(
    solver: PreconditionedMINRES,
    state: _State,
    vector: PyTree[Array],
    options: dict[str, Any],
) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
    linear, inverse, factors = state

    def attempt(last: _Attempt) -> _Attempt:
        def approximate_inverse(r: PyTree[Array]) -> PyTree[Array]:
            full = lambda: point_of(inverse.apply(factors, table_of(r)), r)
            diagonal = lambda: jax.tree.map(lambda x: x / solver.stiffness, r)
            return jax.lax.cond(last.preconditioned, full, diagonal)

        operator = lx.FunctionLinearOperator(
            approximate_inverse, linear.in_structure(), lx.positive_semidefinite_tag
        )
        solution, result, stats = solver.plain.compute(
            linear, vector, options | {"preconditioner": operator}
        )
        stats = stats | {"num_steps": stats["num_steps"] + last.stats["num_steps"]}
        failed = stats["inconsistent"] | (result != lx.RESULTS.successful)
        again = last.preconditioned & failed
        return _Attempt(solution, result, jax.tree.map(jnp.asarray, stats), ~again, again)

    outcome = jax.eval_shape(lambda: solver.plain.compute(linear, vector, options))
    solution, result, stats = zeros_of(outcome)
    start = _Attempt(solution, result, stats, inverse.coarse, jnp.array(True))
    end = jax.lax.while_loop(lambda last: last.again, attempt, start)
    return end.solution, end.result, end.stats
