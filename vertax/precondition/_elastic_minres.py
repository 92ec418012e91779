"""MINRES for the Hessian of a tissue of which more is known."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax.precondition._edge_blocks import EdgeBlocks, EdgeCompliance
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.precondition._recycled_hessian import RecycledHessian
from vertax.solvers._minres import MINRES


class _Attempt(NamedTuple):
    """What came of solving a system with such help or, the second time, without."""

    solution: PyTree[Array]
    result: lx.RESULTS
    stats: dict[str, Array]
    helped: Bool[Array, ""]
    again: Bool[Array, ""]


class ElasticMINRES(lx.AbstractLinearSolver[tuple[Any, Any, EdgeCompliance | None]]):
    """MINRES for the Hessian of a tissue, preconditioned by its edges and its collective motions.

    Where the system has no solution, as if there are zero modes that the right-hand side sees, the result
    would depend on the preconditioner: such a system is solved again without.
    """

    plain: MINRES
    edges: EdgeBlocks | None
    collective: ElasticMedium | RecycledHessian
    stiffness: Float[Array, ""]

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[Any, Any, EdgeCompliance | None]:
        linear = self.plain.init(operator, options)
        medium: Any = self.collective.measured(linear.mv, operator.in_structure(), self.stiffness)
        edges = None if self.edges is None else self.edges.compliance()
        return linear, self.collective.compliance(medium), edges

    def compute(
        self,
        state: tuple[Any, Any, EdgeCompliance | None],
        vector: PyTree[Array],
        options: dict[str, Any],
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        return sequential_vmap_on_cpu(_solve)(self, state, vector, options)

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return self.plain.assume_full_rank()


def _solve(
    solver: ElasticMINRES,
    state: tuple[Any, Any, EdgeCompliance | None],
    vector: PyTree[Array],
    options: dict[str, Any],
) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
    linear, medium, edges = state

    def attempt(last: _Attempt) -> _Attempt:
        def approximate_inverse(r: PyTree[Array]) -> PyTree[Array]:
            alone = jax.tree.map(lambda x: x / solver.stiffness, r)
            helped = lambda: solver.collective.added(
                medium, alone if edges is None else edges(r), r
            )
            return jax.lax.cond(last.helped, helped, lambda: alone)

        preconditioner = lx.FunctionLinearOperator(
            approximate_inverse, linear.in_structure(), lx.positive_semidefinite_tag
        )
        helped = options | {"preconditioner": preconditioner}
        solution, result, stats = solver.plain.compute(linear, vector, helped)
        stats = stats | {"num_steps": stats["num_steps"] + last.stats["num_steps"]}
        doubtful = stats["inconsistent"] | (result != lx.RESULTS.successful)
        again = last.helped & doubtful
        return _Attempt(solution, result, jax.tree.map(jnp.asarray, stats), ~again, again)

    outcome = jax.eval_shape(lambda: solver.plain.compute(linear, vector, options))
    solution, result, stats = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), outcome)
    start = _Attempt(solution, result, stats, solver.collective.ready, jnp.array(True))
    end = jax.lax.while_loop(lambda last: last.again, attempt, start)
    return end.solution, end.result, end.stats
