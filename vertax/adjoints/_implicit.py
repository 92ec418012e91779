"""Implicit differentiation at equilibrium."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, cast

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from vertax._base.checks import check_choice
from vertax._base.optimistix import Minimisation
from vertax._base.results import RESULTS, index_of
from vertax._base.scales import Scales
from vertax._base.tracing import frozen
from vertax.adjoints._adjoint import (
    MAX_RELATIVE_RESIDUAL,
    AbstractAdjoint,
    GradientOutcome,
    finish_gradient,
    materialise,
)
from vertax.precondition._preconditioned_minres import PreconditionedMINRES
from vertax.precondition._sum import Preconditioner
from vertax.solvers import MINRES


class ImplicitDifferentiation(AbstractAdjoint):
    r"""Gradients through an equilibrium by the implicit function theorem (paper, Methods, "ID").

    At equilibrium $\nabla_X E(X^*, \theta) = 0$, so the equilibrium moves with its parameters as

    $$\frac{dX^*}{d\theta} = -H^{-1}\, \nabla^2_{X\theta} E, \qquad H = \nabla^2_X E.$$

    Memory does not grow with the number of relaxation steps. The relaxation must have converged: a residual
    force $g$ gives an error of order $H^{-1} g$ in the gradient. Forward and reverse mode work, and higher
    derivatives.

    **Arguments:**

    - `mode`: `"adjoint"` (Adj-ID) solves one system per derivative: in reverse mode one per cost,
        independent of the number of parameters. `"sensitivity"` (Sen-ID) solves the systems of all
        parameters as one batch and multiplies by the result: for a forward-mode Jacobian, or for comparison
        with the paper; time and memory grow with the number of parameters.
    - `linear_solver`: solves the systems with the Hessian, which is symmetric and may be indefinite.
    - `throw`, `outcome`: see [`AbstractAdjoint`][vertax.adjoints.AbstractAdjoint]. A gradient is unreliable
        if the linear solver reports failure, or if the system $H \lambda = b$ is degenerate. It is degenerate
        if (1) it has only a least-squares solution, with a relative residual above 1 %; or (2) the residual
        is above $\|b\|$; or (3) the effective stiffness $\|b\| / \|\lambda\|$ is below
        $\max(\sqrt{\epsilon}\,k, 10\, f / \ell)$ with the mean stiffness $k$, the size of a cell $\ell$,
        and the force tolerance $f$ of the relaxation. (In units of $k$ that is 1.5e-8 in float64; below it
        $\lambda$ has no correct digit, or the error of the position is above $\ell / 10$.) In forward and in
        `"sensitivity"` mode the systems do not depend on the cost: their solution is the one of least norm,
        and degenerate if a parameter exerts forces along motions without stiffness.

    **Raises:**

    - `ValueError` for another mode.
    """

    mode: Literal["adjoint", "sensitivity"] = eqx.field(static=True, default="adjoint")
    linear_solver: lx.AbstractLinearSolver[Any] = eqx.field(default_factory=MINRES)
    throw: bool = eqx.field(default=True, kw_only=True)
    outcome: GradientOutcome | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        check_choice("mode", self.mode, ("adjoint", "sensitivity"))

    def apply(
        self,
        primal_fn: Callable,
        rewrite_fn: Callable,
        inputs: PyTree,
        tags: frozenset[object],
    ) -> PyTree[Any]:
        minimisation = frozen(Minimisation.of(primal_fn, inputs))
        root, residual = minimisation.run()
        root, residual = frozen(root), jax.tree.map(eqxi.nondifferentiable_backward, residual)
        adjoint = cast(ImplicitDifferentiation, self.without_outcome())
        options = minimisation.options
        preconditioner = options.get("preconditioner", Preconditioner(None, None))
        coarse = preconditioner.coarse
        if coarse is not None and isinstance(self.linear_solver, MINRES):
            solver = PreconditionedMINRES(
                self.linear_solver, preconditioner, Scales.of(options).stiffness
            )
            adjoint = eqx.tree_at(lambda a: a.linear_solver, adjoint, solver)
        system = _System(
            adjoint,
            rewrite_fn,
            residual,
            tags | {lx.symmetric_tag},
            _min_stiffness(options, root),
            ~jnp.asarray(options.get("exists", True)),
        )
        if self.outcome is None:
            return _follow(inputs, root, system), residual
        return _follow_and_report((inputs, self.outcome), root, system), residual


class _System(eqx.Module):
    r"""The linear systems behind the derivatives of a root of $g(X, \theta) = \nabla_X E$."""

    adjoint: ImplicitDifferentiation
    rewrite_fn: Callable = eqx.field(static=True)
    residual: PyTree
    tags: frozenset[object] = eqx.field(static=True)
    min_stiffness: Array
    broken: Array
    """Whether the relaxation ended with NaN, so that there is no root."""

    def force(self, root: PyTree[Array], inputs: PyTree) -> PyTree[Array]:
        return self.rewrite_fn(root, self.residual, inputs)

    def solve(
        self, root: PyTree[Array], inputs: PyTree, rhs: PyTree[Array], *, strict: bool = False
    ) -> tuple[PyTree[Array], GradientOutcome]:
        operator = lx.JacobianLinearOperator(self.force, root, inputs, tags=self.tags)
        return jax.lax.custom_linear_solve(
            operator.mv,
            rhs,
            lambda _, vector: self._solve_once(operator, vector, strict),
            symmetric=True,
            has_aux=True,
        )

    def _solve_once(
        self, operator: lx.AbstractLinearOperator, vector: PyTree[Array], strict: bool
    ) -> tuple[PyTree[Array], GradientOutcome]:
        """The solution and its outcome; raises an error for an unreliable outcome if `strict`.

        If the relaxation ended with NaN, the solution is 0: the other members of a batch are right.
        """
        solver = self.adjoint.linear_solver
        solution, result, stats = solver.compute(solver.init(operator, {}), vector, {})
        stat = lambda name: jnp.asarray(stats.get(name, -1.0), float)
        residual, failed = stat("residual_norm"), result != lx.RESULTS.successful
        rhs, response = optx.two_norm(vector), optx.two_norm(solution)
        soft = (rhs > 0) & (rhs < self.min_stiffness * response)
        # The residual of MINRES decreases in each step. A final residual above |b|, or stagnation at a large
        # residual, occurs only if rounding errors along null vectors grow without bound.
        large = (residual > 1) | ((stat("stagnated") == 1) & (residual > MAX_RELATIVE_RESIDUAL))
        diverged = failed & (large | (result == lx.RESULTS.singular))
        degenerate = (
            soft | diverged | ((stat("inconsistent") == 1) & (residual > MAX_RELATIVE_RESIDUAL))
        )
        solved = RESULTS.where(failed, RESULTS.linear_solve_failed, RESULTS.successful)
        outcome = GradientOutcome(
            residual,
            stat("num_steps"),
            stat("negative_curvature"),
            index_of(RESULTS.where(degenerate, RESULTS.degenerate, solved)),
        )
        outcome = jax.tree.map(lambda x: x.astype(float), outcome)
        if strict:
            solution = outcome.result.error_if(solution, ~outcome.converged & ~self.broken)
        return jax.tree.map(lambda x: jnp.where(self.broken, 0, x), solution), outcome

    def tangent(
        self, root: PyTree[Array], inputs: PyTree, t_inputs: PyTree, *, strict: bool = False
    ) -> tuple[PyTree[Array], GradientOutcome]:
        """The derivative of the root along a tangent of the inputs; None entries are fixed inputs."""
        moving, fixed = _split(inputs, t_inputs)
        force = lambda m: self.force(root, eqx.combine(m, fixed))
        _, rhs = jax.jvp(force, (moving,), (t_inputs,))
        response, outcome = self.solve(root, inputs, rhs, strict=strict)
        return jax.tree.map(jnp.negative, response), outcome

    def sensitivities(
        self, root: PyTree[Array], inputs: PyTree, t_inputs: PyTree, *, strict: bool = False
    ) -> tuple[PyTree[Array], GradientOutcome]:
        """The Jacobian of the root by the inputs that have a tangent: one row per number, on a new first
        axis."""
        moving, _ = _split(inputs, t_inputs)
        flat, unravel = ravel_pytree(moving)

        def one(direction: Array) -> tuple[PyTree[Array], GradientOutcome]:
            t = _with_structure_of(unravel(direction), t_inputs)
            return self.tangent(root, inputs, t, strict=strict)

        return jax.vmap(one)(jnp.eye(flat.size, dtype=flat.dtype))


def _min_stiffness(options: dict[str, Any], root: PyTree[Array]) -> Array:
    """The effective stiffness below which a system is degenerate, see the class; 0 without scales."""
    dtype = jnp.result_type(*jax.tree.leaves(root))
    if "scales" not in options:
        return jnp.zeros((), dtype)
    scales = Scales.of(options)
    rounding = jnp.finfo(dtype).eps ** 0.5 * scales.stiffness
    positional = jnp.where(jnp.isinf(scales.tolerance), 0, 10 * scales.tolerance / scales.length)
    return jnp.asarray(jnp.maximum(rounding, positional), dtype)


def _split(inputs: PyTree, t_inputs: PyTree) -> tuple[PyTree, PyTree]:
    absent = jax.tree.map(lambda t: t is None, t_inputs, is_leaf=lambda t: t is None)
    fixed, moving = eqx.partition(inputs, absent, is_leaf=lambda t: t is None)
    return moving, fixed


def _with_structure_of(tangent: PyTree, structure: PyTree) -> PyTree:
    return jax.tree.unflatten(jax.tree.structure(structure), jax.tree.leaves(tangent))


@eqx.filter_custom_jvp
def _follow(inputs: PyTree, root: PyTree[Array], system: _System) -> PyTree[Array]:
    return root


@_follow.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[PyTree[Array], PyTree[Array]]:
    inputs, _, system = primals
    t_inputs, *_ = tangents
    # The root depends on the inputs too: second derivatives need its tangent.
    root = _follow(*primals)
    strict = system.adjoint.throw
    if system.adjoint.mode == "adjoint":
        t_root, _ = system.tangent(root, inputs, t_inputs, strict=strict)
    else:
        columns, _ = system.sensitivities(root, inputs, t_inputs, strict=strict)
        weights = ravel_pytree(t_inputs)[0]
        t_root = jax.tree.map(lambda c: jnp.tensordot(weights, c, 1), columns)
    return root, t_root


@eqx.filter_custom_vjp
def _follow_and_report(
    vjp_arg: tuple[PyTree, GradientOutcome], root: PyTree[Array], system: _System
) -> PyTree[Array]:
    return root


@_follow_and_report.def_fwd
def _(perturbed: Any, vjp_arg: Any, root: PyTree[Array], system: _System) -> tuple:
    inputs, _ = vjp_arg
    return _follow(inputs, root, system), None


@_follow_and_report.def_bwd
def _(residuals: None, cotangent: Any, perturbed: Any, vjp_arg: Any, root: Any, system: Any) -> Any:
    inputs, slot = vjp_arg
    wanted, _ = perturbed
    moving, fixed = eqx.partition(inputs, wanted)
    root = _follow(inputs, root, system)
    cotangent = materialise(cotangent, root)
    if system.adjoint.mode == "adjoint":
        multiplier, outcome = system.solve(root, inputs, cotangent)
        _, vjp = jax.vjp(lambda m: system.force(root, eqx.combine(m, fixed)), moving)
        gradient = jax.tree.map(jnp.negative, vjp(multiplier)[0])
    else:
        columns, outcomes = system.sensitivities(root, inputs, moving)
        parts = jax.tree.map(lambda c, g: jnp.tensordot(c, g, g.ndim), columns, cotangent)
        gradient = ravel_pytree(moving)[1](jax.tree.reduce(jnp.add, parts))
        outcome = GradientOutcome(
            jnp.max(outcomes.residual),
            jnp.max(outcomes.num_steps),
            jnp.max(outcomes.negative_curvature),
            jnp.max(outcomes.code),
        )
    return finish_gradient(gradient, outcome, system.adjoint.throw, slot)
