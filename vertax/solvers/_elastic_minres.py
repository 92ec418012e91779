"""MINRES for the Hessian of a large tissue."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, PyTree

from vertax.solvers._long_waves import LongWaves, Medium
from vertax.solvers._minres import MINRES


class ElasticMINRES(lx.AbstractLinearSolver[tuple[Any, Medium]]):
    """MINRES for the Hessian of a large tissue, preconditioned by its long waves.

    Where the system has no solution, as if there are zero modes that the right-hand side sees, the result
    would depend on the preconditioner: such a system is solved again without.
    """

    plain: MINRES
    waves: LongWaves
    stiffness: Float[Array, ""]

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[Any, Medium]:
        linear = self.plain.init(operator, options)
        return linear, self.waves.fitted(linear.mv, operator.in_structure(), self.stiffness)

    def compute(
        self, state: tuple[Any, Medium], vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        linear, medium = state

        def approximate_inverse(r: PyTree[Array]) -> PyTree[Array]:
            near = jax.tree.map(lambda x: x / self.stiffness, r)
            return medium.added(near, r, jnp.zeros_like(self.stiffness))

        preconditioner = lx.FunctionLinearOperator(
            approximate_inverse, linear.in_structure(), lx.positive_semidefinite_tag
        )
        helped = self.plain.compute(linear, vector, options | {"preconditioner": preconditioner})
        taken = helped[2]["num_steps"]

        def plainly(last: tuple) -> tuple:
            solution, result, stats = self.plain.compute(linear, vector, options)
            return solution, result, stats | {"num_steps": stats["num_steps"] + taken}, False

        def unsolved(last: tuple) -> Any:
            *_, doubtful = last
            return doubtful

        arrays = lambda x: jax.tree.map(jnp.asarray, x)
        value, result, stats = helped
        doubtful = stats["inconsistent"] | (result != lx.RESULTS.successful)
        # (A loop and not a branch, of which `vmap` would make both.)
        *solved, _ = jax.lax.while_loop(
            unsolved, lambda x: arrays(plainly(x)), arrays((value, result, stats, doubtful))
        )
        return tuple(solved)  # pyright: ignore[reportReturnType]

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return self.plain.assume_full_rank()
