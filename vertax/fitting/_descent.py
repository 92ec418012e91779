"""Epochs of an Optax optimiser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from vertax._base.announce import announced_jit
from vertax._base.fingerprint import fingerprint
from vertax._base.results import RESULTS, first_failure, result_of, where_is
from vertax._base.tracing import traced, tree_where
from vertax.fitting._epoch import (
    AbstractMethod,
    Best,
    better,
    first_line,
    guidance_of,
    no_shift,
    over_members,
    relative_error,
    unbeaten,
)
from vertax.fitting._history import Facts, Record
from vertax.fitting._inverse import Evaluation, InverseProblem
from vertax.mesh import Tissue


class State(eqx.Module):
    """State at the start of an epoch."""

    parameters: PyTree[Array]
    optimiser: PyTree
    tissue: Tissue
    best: Best
    result: RESULTS
    """The first failure: an invalid cost or gradient."""

    @property
    def active(self) -> np.ndarray:
        """False after an epoch with an invalid cost or gradient."""
        return where_is(self.result, RESULTS.successful)


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
    """Cache: the problem of the last epoch, and that of the compiled functions."""

    def __check_init__(self):
        calculation, arguments = self._one_update()
        try:
            jax.eval_shape(calculation, *arguments)
        except Exception as error:
            raise TypeError(
                "Argument `optimiser` must be an Optax optimiser that needs parameters, gradient and cost "
                f"alone, but its update raises {type(error).__name__}: {first_line(error)}. {_remedy(error)}"
            ) from error

    def _evaluation(self, problem: InverseProblem, state: State) -> Evaluation:
        if self.batched:
            return _evaluate_batch(problem, self.constants, state)
        # Rebuild only if something changed: that takes as long as an epoch of a small tissue.
        if not self.recent or self.recent[0] is not problem:
            self.recent[:] = [problem, problem.without_parameters(state.tissue)]
        shift = no_shift(problem)
        return self.recent[1].evaluate(state.tissue, state.parameters, self.constants, shift)

    def start(self) -> State:
        return _start(self._without_throw(), self.optimiser, self.parameters, self.batched)

    def advance(self, state: State, epoch: int) -> tuple[State, Record]:
        strength = None
        if self.guidance is not None:
            strength = jnp.asarray(self.strength(epoch), self.problem.tissue.vertices.dtype)
        problem = self._without_throw(strength)
        evaluation = self._evaluation(problem, state)
        next_tissue = problem.next_start(evaluation.equilibrium.tissue)
        guidance = np.broadcast_to(guidance_of(problem), np.shape(state.result._value))
        arguments = (state, evaluation, next_tissue, self.true, guidance)
        epoch_index = np.asarray(epoch, jnp.result_type(int))
        settings = (self.problem.adjoint.throw, self.batched)
        return _update(self.optimiser, arguments, epoch_index, *settings)

    def first_epoch(self) -> Evaluation:
        # (Of the guidance a checkpoint holds the strength in each epoch.)
        return self._evaluation(self._without_throw(), self.start())

    def description(self) -> str:
        # An Optax optimiser consists of closures, which do not print their constants.
        calculation, shapes = self._one_update()
        return fingerprint(
            calculation, *jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        )

    def _one_update(self) -> tuple[Callable[[optax.Params, Array], optax.Params], tuple]:
        """The first update of the optimiser as a function, and the shapes of its arguments."""
        update = optax.with_extra_args_support(self.optimiser).update

        def calculation(fitted: optax.Params, value: Array) -> optax.Params:
            state = self.optimiser.init(fitted)
            return update(fitted, state, fitted, value=value, grad=fitted)[0]

        shape_of = lambda x: jax.ShapeDtypeStruct(x.shape[1:] if self.batched else x.shape, x.dtype)
        parameters = jax.tree.map(shape_of, self.parameters)
        dtype = self.problem.tissue.vertices.dtype
        shift = jax.ShapeDtypeStruct((2,), dtype) if self.problem.fit_position else None
        return calculation, (_fitted(parameters, shift), jax.ShapeDtypeStruct((), dtype))

    def strength(self, epoch: int) -> float:
        if self.guidance is None:
            return float("nan")
        value = np.asarray(self.guidance(jnp.array(epoch)))
        if value.shape or not value >= 0:
            raise ValueError(
                f"Argument `guidance` must return one number that is not negative, but returned {value}."
            )
        return float(value)

    def _without_throw(self, strength: Float[Array, ""] | None = None) -> InverseProblem:
        """The problem with an adjoint that does not raise; invalid gradients are handled for each member."""
        if strength is None and self.recent:
            return self.recent[0]
        problem = eqx.tree_at(lambda p: p.adjoint.throw, self.problem, False)
        if strength is None:
            return problem
        if self.batched:
            strength = jnp.full(len(problem.tissue.vertices), strength)
        # `dataclasses.replace` would check annotations, but in a batch each array has one more axis.
        return eqx.tree_at(lambda p: p.guidance, problem, strength, is_leaf=lambda x: x is None)


def _fitted(parameters: PyTree, shift: Any) -> optax.Params:
    """The arrays that the optimiser changes: the parameters, and the displacement if it is fitted."""
    return cast(optax.Params, parameters if shift is None else (parameters, shift))


def _remedy(error: Exception) -> str:
    if "value_fn" in str(error):
        return (
            "A line search would relax the tissue many times in an epoch. Pass an optimiser without "
            "one, such as optax.lbfgs(0.1, linesearch=None), or a least-squares solver, such as "
            "optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)."
        )
    return (
        "Give labels as a function of the fitted arrays, optax.partition(optimisers, lambda parameters: "
        "labels); with `fit_position` these are a pair of parameters and displacement. Or pass another "
        "optimiser, such as optax.adam(1e-2)."
    )


@announced_jit
def _start(
    problem: InverseProblem,
    optimiser: optax.GradientTransformation,
    parameters: PyTree[Array],
    batched: bool,
) -> State:
    def start(problem: InverseProblem, parameters: PyTree[Array]) -> State:
        fitted = _fitted(parameters, no_shift(problem))
        best = unbeaten(problem, parameters)
        state = traced(optimiser.init(fitted), problem.tissue.vertices.dtype)
        zero = jnp.zeros((), jnp.result_type(int))
        return State(parameters, state, problem.tissue, best, result_of(zero))

    return (eqx.filter_vmap(start) if batched else start)(problem, parameters)


def _evaluation(problem: InverseProblem, constants: PyTree, state: State) -> Evaluation:
    """Cost and gradient of an epoch, by the compiled functions of `value_and_gradient`."""
    energy = eqx.combine(state.parameters, constants)
    return problem.value_and_gradient(energy, state.tissue, no_shift(problem), throw=False)


@announced_jit
def _evaluate_batch(problem: InverseProblem, constants: PyTree, state: State) -> Evaluation:
    """`_evaluation` for each member of a batch, in one compiled function."""
    return over_members(_evaluation, problem)(problem, constants, state)


@announced_jit
def _update(
    optimiser: optax.GradientTransformation,
    arguments: tuple,
    epoch: Int[Array | np.ndarray, ""],
    throw: bool,
    batched: bool,
) -> tuple[State, Record]:
    """One update of the parameters, for each member of a batch."""

    def one(
        state: State,
        evaluation: Evaluation,
        next_tissue: Tissue,
        true: PyTree[Array] | None,
        guidance: Float[Array, ""],
    ) -> tuple[State, Record]:
        shift = (
            None if evaluation.shift_gradient is None else jnp.zeros_like(evaluation.shift_gradient)
        )
        gradient = _fitted(evaluation.gradient, evaluation.shift_gradient)
        equilibrium = evaluation.equilibrium
        record = _record(state.parameters, evaluation, gradient, true, throw)
        result = first_failure(state.result, record.result)
        active = result == RESULTS.successful
        fitted = _fitted(state.parameters, shift)
        updates, optimiser_state = optax.with_extra_args_support(optimiser).update(
            cast(optax.Updates, gradient),
            state.optimiser,
            fitted,
            value=evaluation.cost,
            grad=gradient,
        )
        parameters = eqx.apply_updates(fitted, updates)
        if shift is not None:
            parameters, shift = parameters
            next_tissue = next_tissue.with_vertices(next_tissue.vertices + shift)
        best = better(
            state.best,
            state.parameters,
            equilibrium.tissue,
            Facts(**record.facts()),
            guidance,
            epoch,
            active & equilibrium.converged,
        )
        updated = State(parameters, optimiser_state, next_tissue, best, result)
        # After a failed epoch keep the previous state, so that no relaxation starts from an invalid tissue.
        return tree_where(active, updated, eqx.tree_at(lambda s: s.result, state, result)), record

    return (eqx.filter_vmap(one) if batched else one)(*arguments)


def _record(
    parameters: PyTree[Array],
    evaluation: Evaluation,
    gradient: PyTree[Array],
    true: PyTree[Array] | None,
    throw: bool,
) -> Record:
    equilibrium, outcome = evaluation.equilibrium, evaluation.outcome
    norm = optax.tree.norm(gradient)
    finite, not_finite = jnp.isfinite(evaluation.cost) & jnp.isfinite(norm), RESULTS.not_finite_cost
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
        result=RESULTS.where(finite, outcome.result if throw else RESULTS.successful, not_finite),
    )
