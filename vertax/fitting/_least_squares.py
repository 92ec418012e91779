"""Epochs of a least-squares solver of Optimistix."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checkpoints import without_addresses
from vertax._base.results import RESULTS, result_of
from vertax._base.tracing import tree_where
from vertax.adjoints import ImplicitDifferentiation
from vertax.fitting._epoch import (
    AbstractMethod,
    Best,
    better,
    guidance_of,
    no_shift,
    nothing_known,
    over_members,
    relative_error,
    unbeaten,
)
from vertax.fitting._history import MISSING, Facts, Record
from vertax.fitting._inverse import InverseProblem
from vertax.mesh import Tissue

# The fit ends after this number of consecutive rejected steps.
_MAX_REJECTED_STEPS = 8
_TAGS: frozenset[object] = frozenset()


class State(eqx.Module):
    """State at the start of an epoch."""

    fitted: PyTree[Array]
    """Parameters and displacement of the last accepted step."""
    solver: list[Array]
    """The arrays of the solver state; `_Solver` restores its other leaves, which are compiled functions."""
    tissue: Tissue
    """The start of the next relaxation."""
    placed: Tissue
    """The equilibrium of the last accepted step, with its displacement."""
    facts: Facts
    """The scalars of the last accepted step."""
    scale: Float[Array, "*batch"]
    """Factor of the residuals in the solver."""
    best: Best
    n_rejected: Int[Array, "*batch"]
    """Number of consecutive rejected steps."""
    active: Bool[Array, "*batch"]
    """False when the solver has ended."""

    @property
    def result(self) -> RESULTS:
        """Successful: the solver shortens steps that fail."""
        return result_of(jnp.zeros_like(self.n_rejected))


class LeastSquares(AbstractMethod):
    """Epochs of a least-squares solver."""

    solver: optx.AbstractLeastSquaresSolver
    problem: InverseProblem
    parameters: PyTree[Array]
    constants: PyTree
    true: PyTree[Array] | None
    batched: bool

    def start(self) -> State:
        primal, problem = None, self.problem
        if not self.batched:
            energy = eqx.combine(self.parameters, self.constants)
            primal = problem.primal(energy, problem.tissue, no_shift(problem))
        parts = (problem, self.constants, self.true, self.parameters, primal)
        return _start(self.solver, parts, self.batched)

    def advance(self, state: State, epoch: int) -> tuple[State, Record]:
        return _epoch(
            self.solver,
            self.problem,
            self.constants,
            self.true,
            state,
            jnp.array(epoch),
            self.batched,
        )

    def first_epoch(self) -> tuple[State, Record]:
        return self.advance(self.start(), 0)

    def description(self) -> str:
        return without_addresses(eqx.tree_pformat(self.solver, short_arrays=False))

    def strength(self, epoch: int) -> float:
        return float("nan")


class _Solver(eqx.Module):
    """The solver with the residual function of one problem."""

    solver: optx.AbstractLeastSquaresSolver
    evaluate: Callable
    blank: Any
    """The initial state of the solver."""
    aux: Any
    options: dict[str, Any]

    def __init__(
        self,
        solver: optx.AbstractLeastSquaresSolver,
        problem: InverseProblem,
        constants: PyTree,
        true: PyTree[Array] | None,
        fitted: PyTree[Array],
        scale: Float[Array, ""],
    ):
        evaluate = _residuals(problem, constants, true, scale)
        # Forward mode solves the linear systems of all parameters as one batch; only implicit differentiation
        # supports it.
        forward = isinstance(problem.adjoint, ImplicitDifferentiation)
        self.options = {"jac": "fwd" if forward else "bwd"}
        self.solver = solver
        fn = eqx.filter_closure_convert(evaluate, fitted, problem.tissue)
        residuals, self.aux = fn.out_struct  # pyright: ignore[reportFunctionMemberAccess]
        self.blank = solver.init(
            fn, fitted, problem.tissue, self.options, residuals, self.aux, _TAGS
        )
        self.evaluate = fn

    def restored(self, leaves: list[Array]) -> Any:
        """The solver state with the given arrays."""
        dynamic, static = eqx.partition(self.blank, eqx.is_array)
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(dynamic), leaves), static)

    def step(self, state: State) -> tuple[PyTree, Any, Bool[Array, ""]]:
        """The last accepted point, the solver state, and whether the solver has ended."""
        solver_state = self.restored(state.solver)
        arguments = (self.options, solver_state, _TAGS)
        y, solver_state, _ = self.solver.step(self.evaluate, state.fitted, state.tissue, *arguments)
        arguments = (self.options, solver_state, _TAGS)
        done, result = self.solver.terminate(self.evaluate, y, state.tissue, *arguments)
        return y, solver_state, done | (result != optx.RESULTS.successful)


def _residuals(
    problem: InverseProblem,
    constants: PyTree,
    true: PyTree[Array] | None,
    scale: Float[Array, ""],
    primal: PyTree = None,
) -> Callable[[PyTree, Tissue], tuple[Array, tuple]]:
    """A function that returns the residuals, and as aux the tissues and scalars of the equilibrium."""

    def evaluate(y: PyTree, tissue: Tissue) -> tuple[Array, tuple]:
        parameters, shift = y
        energy = eqx.combine(parameters, constants)
        residuals, relaxed, placed = problem.residuals(energy, tissue, shift, primal)
        # After a failed relaxation the solver must reject the step and try a shorter one: return very large
        # residuals.
        worst = jnp.asarray(jnp.finfo(residuals.dtype).max ** 0.25, residuals.dtype)
        valid = relaxed.converged & jnp.all(jnp.isfinite(residuals))
        residuals = jnp.where(valid, scale * residuals, worst)
        missing = jnp.full_like(scale, MISSING)
        facts = Facts(
            cost=0.5 * jnp.sum((residuals / scale) ** 2),
            max_force=relaxed.max_force,
            converged=valid,
            num_steps=relaxed.num_steps,
            num_t1=relaxed.num_t1,
            gradient_norm=missing,
            gradient_residual=missing,
            gradient_steps=missing,
            relative_error=relative_error(parameters, true),
        )
        tissues = (problem.next_start(relaxed.tissue), placed)
        return residuals, (eqx.filter(tissues, eqx.is_array), facts)

    return evaluate


@announced_jit
def _start(solver: optx.AbstractLeastSquaresSolver, parts: tuple, batched: bool) -> State:
    def start(
        problem: InverseProblem,
        constants: PyTree,
        true: PyTree,
        parameters: PyTree,
        primal: PyTree,
    ) -> State:
        # Scale the residuals to norm 1, which suits the initial damping of the solver.
        fitted = (parameters, no_shift(problem))
        one = jnp.ones((), problem.tissue.vertices.dtype)
        first, _ = _residuals(problem, constants, true, one, primal)(fitted, problem.tissue)
        scale = jax.lax.rsqrt(jnp.maximum(jnp.sum(first**2), jnp.finfo(first.dtype).tiny))
        machine = _Solver(solver, problem, constants, true, fitted, scale)
        leaves = _leaves(machine.blank)
        facts = nothing_known(problem)
        best = unbeaten(problem, parameters)
        tissues = (problem.tissue, problem.tissue)
        n_rejected, active = jnp.array(0), jnp.array(True)
        return State(fitted, leaves, *tissues, facts, scale, best, n_rejected, active)

    return (over_members(start, parts[0]) if batched else start)(*parts)


@announced_jit
def _epoch(
    solver: optx.AbstractLeastSquaresSolver,
    problem: InverseProblem,
    constants: PyTree,
    true: PyTree[Array] | None,
    state: State,
    epoch: Int[Array, ""],
    batched: bool,
) -> tuple[State, Record]:
    """One relaxation, Jacobian and step, for each active member of a batch."""

    def one(
        problem: InverseProblem, constants: PyTree, true: PyTree[Array] | None, state: State
    ) -> tuple[State, Record]:
        machine = _Solver(solver, problem, constants, true, state.fitted, state.scale)
        y, solver_state, done = machine.step(state)
        arrays, facts = solver_state.aux  # of the last accepted point y
        tissue, placed = (eqx.combine(a, problem.tissue) for a in arrays)
        best = better(state.best, y[0], placed, facts, guidance_of(problem), epoch, facts.converged)
        n_rejected = jnp.where(facts.cost == state.facts.cost, state.n_rejected + 1, 0)
        leaves = _leaves(solver_state)
        active = ~done & (n_rejected < _MAX_REJECTED_STEPS)
        updated = State(y, leaves, tissue, placed, facts, state.scale, best, n_rejected, active)
        # In a batch members that have ended keep their state.
        state = tree_where(state.active, updated, state)
        return state, _record(state)

    arguments = (problem, constants, true, state)
    return (over_members(one, problem) if batched else one)(*arguments)


def _record(state: State) -> Record:
    return Record(
        parameters=state.fitted[0],
        tissue=state.placed,
        result=RESULTS.successful,
        **state.facts.facts(),
    )


def _leaves(state: Any) -> list[Array]:
    """The arrays of a solver state, with constants of the compilation converted to arrays."""
    return [jnp.asarray(x) for x in jax.tree.leaves(eqx.filter(state, eqx.is_array))]
