"""Epochs of an Optax optimiser."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from vertax._base.announce import announced_jit
from vertax._base.checkpoints import without_addresses
from vertax._base.tracing import traced, tree_where
from vertax.fitting._epoch import (
    AbstractMethod,
    Best,
    better,
    guidance_of,
    no_shift,
    over_members,
    relative_error,
    unbeaten,
)
from vertax.fitting._history import Facts, Record
from vertax.fitting._inverse import Evaluation, InverseProblem
from vertax.mesh import Tissue
from vertax.precondition._recycled_hessian import RecycledHessian

# When the Hessian is worked out: that takes as long as a few epochs, and to compile it as long as hundreds.
_FIRST_LOOK = 100
_NEXT_LOOK = 20


class State(eqx.Module):
    """Where an epoch begins."""

    parameters: PyTree[Array]
    optimiser: PyTree
    tissue: Tissue
    best: Best
    going: Bool[Array, "*batch"]
    """False once an epoch was not sound."""
    hessian: RecycledHessian | None
    """That of an equilibrium some epochs ago;"""
    looked: Int[Array, "*batch"]
    """how many epochs had passed then,"""
    stale: Bool[Array, "*batch"]
    """and whether the tissue is elsewhere now."""


class Descent(AbstractMethod):
    """Epochs of an Optax optimiser."""

    optimiser: optax.GradientTransformation
    problem: InverseProblem
    parameters: PyTree[Array]
    constants: PyTree
    true: PyTree[Array] | None
    batched: bool
    guidance: Callable[[Int[Array, ""]], ArrayLike] | None
    recent: list[Any] = eqx.field(default_factory=list)
    """The problem and the Hessian of the last epoch, and what compiled functions need of both."""

    def _evaluation(self, problem: InverseProblem, state: State) -> Evaluation:
        if self.batched:
            return _evaluate_batch(problem, self.constants, state)
        # Made anew only if something has changed: it takes as long as an epoch of a small tissue.
        if not self.recent or self.recent[0] is not problem or self.recent[1] is not state.hessian:
            response = problem.response.with_preconditioner(state.hessian)
            known = eqx.tree_at(lambda p: p.response, problem, response)
            self.recent[:] = [problem, state.hessian, known.bare(state.tissue)]
        shift = no_shift(problem)
        return self.recent[2].evaluate(state.tissue, state.parameters, self.constants, shift)

    def start(self) -> State:
        return _start(self._lenient(), self.optimiser, self.parameters, self.batched)

    def advance(self, state: State, epoch: int) -> tuple[State, Record]:
        strength = None
        if self.guidance is not None:
            strength = jnp.asarray(self.strength(epoch), self.problem.tissue.vertices.dtype)
        problem, hessian = self._lenient(strength), state.hessian
        wait = _NEXT_LOOK if np.any(state.looked) else _FIRST_LOOK
        due = hessian is not None and epoch >= np.max(state.looked) + wait
        if due and np.any(state.stale & state.going):
            hessian = _hessian_at(problem, self.constants, state, self.batched)
            looked = jnp.full_like(state.looked, epoch)
            state = dataclasses.replace(state, looked=looked, hessian=hessian)
        evaluation = self._evaluation(problem, state)
        following = problem.onward(evaluation.equilibrium.tissue)
        without = dataclasses.replace(state, hessian=None)
        guidance = jnp.broadcast_to(guidance_of(problem), state.going.shape)
        arguments = (without, evaluation, following, hessian, self.true, guidance)
        number = jnp.asarray(epoch, state.looked.dtype)
        settings = (self.problem.adjoint.throw, self.batched)
        state, record = _update(self.optimiser, arguments, number, *settings)
        return dataclasses.replace(state, hessian=hessian), record

    def description(self) -> str:
        # An Optax optimiser is made of functions, which have no names for their constants. What they
        # compute has.
        fitted = cast(optax.Params, (self.parameters, no_shift(self.problem)))
        value = jax.ShapeDtypeStruct((), self.problem.tissue.vertices.dtype)
        update = optax.with_extra_args_support(self.optimiser).update

        def calculation(fitted: optax.Params, value: Array) -> optax.Params:
            state = self.optimiser.init(fitted)
            return update(fitted, state, fitted, value=value, grad=fitted)[0]

        return without_addresses(str(jax.make_jaxpr(calculation)(fitted, value)))

    def strength(self, epoch: int) -> float:
        if self.guidance is None:
            return float("nan")
        value = np.asarray(self.guidance(jnp.array(epoch)))
        if value.shape or not value >= 0:
            raise ValueError(
                f"Argument `guidance` must give one number that is not negative, but gave {value}."
            )
        return float(value)

    def _lenient(self, strength: Float[Array, ""] | None = None) -> InverseProblem:
        # A step that cannot be trusted is refused here, one member of a batch at a time.
        if strength is None and self.recent:
            return self.recent[0]
        problem = eqx.tree_at(lambda p: p.adjoint.throw, self.problem, False)
        if strength is None:
            return problem
        if self.batched:
            strength = jnp.full(len(problem.tissue.vertices), strength)
        # (In a batch each array has one more axis than its annotation, which `replace` would check.)
        return eqx.tree_at(lambda p: p.guidance, problem, strength, is_leaf=lambda x: x is None)


@announced_jit
def _start(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    parameters: PyTree[Array],
    batched: bool,
) -> State:
    def start(problem: InverseProblem, parameters: PyTree[Array]) -> State:
        fitted = cast(optax.Params, (parameters, no_shift(problem)))
        best = unbeaten(problem, parameters)
        unknown = problem.response.preconditioner_at(problem.tissue, None)
        state, yes = traced(optimiser.init(fitted), problem.tissue.vertices.dtype), jnp.array(True)
        none = jnp.zeros((), jnp.result_type(int))
        return State(parameters, state, problem.tissue, best, yes, unknown, none, stale=yes)

    return (eqx.filter_vmap(start) if batched else start)(problem, parameters)


def _evaluation(problem: InverseProblem, constants: PyTree, state: State) -> Evaluation:
    """Cost and gradient of an epoch, by the compiled functions that `value_and_gradient` shares."""
    response = problem.response.with_preconditioner(state.hessian)
    problem = eqx.tree_at(lambda p: p.response, problem, response)
    energy = eqx.combine(state.parameters, constants)
    return problem.value_and_gradient(energy, state.tissue, no_shift(problem), throw=False)


@announced_jit
def _evaluate_batch(problem: InverseProblem, constants: PyTree, state: State) -> Evaluation:
    """The same for each of a batch, in one compiled function."""
    return over_members(_evaluation, problem)(problem, constants, state)


@announced_jit
def _update(
    optimiser: optax.GradientTransformation,
    arguments: tuple,
    epoch: Int[Array, ""],
    throw: bool,
    batched: bool,
) -> tuple[State, Record]:
    """One update of the parameters, for each of the batch."""

    def one(
        state: State,
        evaluation: Evaluation,
        following: Tissue,
        hessian: RecycledHessian | None,
        true: PyTree[Array] | None,
        guidance: Float[Array, ""],
    ) -> tuple[State, Record]:
        shift = (
            None if evaluation.shift_gradient is None else jnp.zeros_like(evaluation.shift_gradient)
        )
        gradient = (evaluation.gradient, evaluation.shift_gradient)
        equilibrium = evaluation.equilibrium
        record = _record(state.parameters, evaluation, gradient, true, throw)
        going = state.going & record.sound
        fitted = (state.parameters, shift)
        updates, optimiser_state = optax.with_extra_args_support(optimiser).update(
            cast(optax.Updates, gradient),
            state.optimiser,
            cast(optax.Params, fitted),
            value=evaluation.cost,
            grad=gradient,
        )
        parameters, shift = eqx.apply_updates(fitted, updates)
        if shift is not None:
            following = following.with_vertices(following.vertices + shift)
        best = better(
            state.best,
            state.parameters,
            equilibrium.tissue,
            Facts(**record.facts()),
            guidance,
            epoch,
            going & equilibrium.converged,
        )
        stale = state.stale
        if hessian is not None:
            stale = ~hessian.near(following.configuration).ready
        moved = State(
            parameters, optimiser_state, following, best, going, None, state.looked, stale
        )
        # A relaxation that broke down must not be where the next one starts.
        return tree_where(going, moved, eqx.tree_at(lambda s: s.going, state, going)), record

    return (eqx.filter_vmap(one) if batched else one)(*arguments)


@announced_jit
def _hessian_at(
    problem: InverseProblem, constants: PyTree, state: State, batched: bool
) -> RecycledHessian | None:
    """The Hessian where an epoch begins, for each of the batch."""

    def one(problem: InverseProblem, constants: PyTree, state: State) -> RecycledHessian | None:
        energy = eqx.combine(state.parameters, constants)
        pulled = problem.pulled(state.tissue, energy, no_shift(problem))
        return problem.response.preconditioner_at(state.tissue, pulled)

    return (eqx.filter_vmap(one) if batched else one)(problem, constants, state)


def _record(
    parameters: PyTree[Array],
    evaluation: Evaluation,
    gradient: PyTree[Array],
    true: PyTree[Array] | None,
    throw: bool,
) -> Record:
    equilibrium, outcome = evaluation.equilibrium, evaluation.outcome
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(evaluation.cost) & jnp.isfinite(norm)
    return Record(
        parameters=parameters,
        tissue=equilibrium.tissue,
        cost=evaluation.cost,
        max_force=equilibrium.max_force,
        converged=equilibrium.converged,
        num_steps=equilibrium.num_steps,
        num_t1=equilibrium.num_t1,
        gradient_norm=norm,
        gradient_residual=outcome.residual,
        gradient_steps=outcome.num_steps,
        relative_error=relative_error(parameters, true),
        sound=finite & outcome.trusted if throw else finite,
    )
