"""The base classes of minimisers."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree
from optax import tree

from vertax._base.rows import Rows
from vertax._base.scales import Scales
from vertax._base.tracing import tree_where, zeros_of

State = TypeVar("State")


class Progress(eqx.Module):
    """The result of an evaluation."""

    accepted: Bool[Array, ""]
    """Whether the evaluated point is the iterate now."""
    stepped: Bool[Array, ""]
    """Whether a step ended, accepted or rejected."""
    moved: Bool[Array, ""]
    """Whether the iterate is another point than before."""
    force: Float[Array, ""]
    """The largest component of the gradient at the iterate."""

    @classmethod
    def initial(cls, force: Float[Array, ""]) -> Progress:
        """The progress before the first evaluation."""
        false = jnp.array(False)
        return cls(false, false, false, force)


class AbstractSolver(optx.AbstractMinimiser):
    """An Optimistix minimiser that judges convergence by the largest force.

    Its state holds the gradient at the point that the last step returned. It stops
    when the norm of the gradient (by default the largest component)
    falls below `atol`; [`equilibrate`][vertax.equilibrate] uses its own `tolerance` instead.
    """

    rtol: float = eqx.field(default=0.0, kw_only=True)
    atol: float = eqx.field(default=1e-8, kw_only=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(
        default=optx.max_norm, kw_only=True, static=True
    )

    @property
    def unrollable(self) -> bool:
        """Whether its steps can be differentiated one by one, as automatic differentiation does.

        The steps of line searches and inner loops depend on comparisons, which have no derivative.
        """
        return False

    @abc.abstractmethod
    def gradient(self, state: Any) -> PyTree[Float[Array, "..."]]:
        """Gradient at the point that the last step (or `init`) returned."""

    def progress(self, state: Any) -> Progress:
        """The result of the last step."""
        true = jnp.array(True)
        return Progress(true, true, true, self.norm(self.gradient(state)))

    def reevaluated(self, fresh: Any, old: Any) -> Any:
        """The old state with the value and the gradient of `fresh`; `fresh` if they are inseparable."""
        return fresh

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        return self.norm(self.gradient(state)) < self.atol, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}


class AbstractIteration(AbstractSolver, Generic[State]):
    """A minimiser in two halves, between which the iterate may be changed.

    Each trip of a relaxation evaluates the objective at the trial point (`evaluate`), applies transitions to
    an accepted point (after which it calls `moved`), and computes the next trial point (`propose`). A
    minimiser that is no `AbstractIteration` restarts after a transition.

    `scales` are the typical sizes of the problem, see [`Scales`][vertax.solvers.Scales].
    """

    @abc.abstractmethod
    def unevaluated(self, fn: Any, y: Any, args: Any, scales: Scales) -> State:
        """The state before the first evaluation, which is at `y`."""

    @abc.abstractmethod
    def evaluate(
        self, fn: Any, y: Any, args: Any, scales: Scales, state: State
    ) -> tuple[Any, State, Any, Any]:
        """Evaluate the trial point.

        **Arguments:**

        - `fn`: the objective, `fn(y, args) -> (value, aux)`.
        - `y`: the iterate.
        - `args`: its arguments.
        - `scales`: typical sizes.
        - `state`: the state.

        **Returns:** the iterate, the state, the model of the objective at the trial point, and the auxiliary
        output.
        """

    @abc.abstractmethod
    def propose(
        self,
        model: Any,
        scales: Scales,
        state: State,
        active: Bool[Array, ""],
        preconditioner: Any = None,
    ) -> State:
        """The next trial point; that of a step only if `active`. Otherwise the iterate is evaluated anew.

        **Arguments:**

        - `model`: the objective at the point that was evaluated, as `evaluate` returned it.
        - `scales`: typical sizes.
        - `state`: the state.
        - `active`: whether the iterate is that point, and a step from it is needed.
        - `preconditioner`: of the Hessian at the iterate, if `uses_preconditioner`.
        """

    @abc.abstractmethod
    def moved(
        self,
        state: State,
        fraction: Rows,
        flipped: Bool[Array, ""],
        changed: Bool[Array, ""],
        scales: Scales,
    ) -> State:
        """The state after the iterate was `changed`.

        **Arguments:**

        - `state`: the state.
        - `fraction`: the fraction of the last step that each row has taken.
        - `flipped`: whether the topology has changed.
        - `changed`: whether the iterate or the objective has changed at all.
        - `scales`: typical sizes.
        """

    @abc.abstractmethod
    def progress(self, state: State) -> Progress:
        """The result of the last evaluation."""

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> State:
        return self.unevaluated(fn, y, args, Scales.of(options))

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: State, tags: Any
    ) -> tuple[Any, State, Any]:
        scales, preconditioner = Scales.of(options), options.get("preconditioner")
        y, state, model, aux = self.evaluate(fn, y, args, scales, state)
        active = self.progress(state).accepted
        return y, self.propose(model, scales, state, active, preconditioner), aux

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: State, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        progress = self.progress(state)
        return progress.accepted & (progress.force < self.atol), optx.RESULTS.successful

    @property
    def uses_preconditioner(self) -> bool:
        """Whether `propose` uses a preconditioner."""
        return False

    def value(self, state: State) -> Float[Array, ""] | None:
        """The objective at the iterate, for a relaxation that ends early if it no longer falls.

        None if it must not: minimisers of first order need thousands of steps.
        """
        return None


def value_and_gradient(fn: Callable, y: PyTree, args: PyTree) -> tuple[Array, PyTree, PyTree]:
    """Value, gradient and auxiliary output of an Optimistix objective `fn(y, args) -> (value, aux)`."""
    (value, aux), gradient = jax.value_and_grad(fn, has_aux=True)(y, args)
    return value, gradient, aux


def with_value_and_gradient(fresh: Any, old: Any) -> Any:
    """A state with the value and the gradient of another one."""
    return eqx.tree_at(lambda s: (s.value, s.gradient), old, (fresh.value, fresh.gradient))


class _StepwiseState(eqx.Module):
    inner: Any
    restart: Int[Array, ""]
    progress: Progress


class Stepwise(AbstractIteration[_StepwiseState]):
    """Any solver as an iteration: each evaluation is one of its steps.

    **Arguments:**

    - `solver`: the solver.
    """

    solver: AbstractSolver

    def unevaluated(self, fn: Any, y: Any, args: Any, scales: Scales) -> _StepwiseState:
        value, aux = eqx.filter_eval_shape(fn, y, args)
        options = {"scales": scales}
        init = lambda y, args: self.solver.init(fn, y, args, options, value, aux, frozenset())
        inner = zeros_of(eqx.filter_eval_shape(init, y, args))
        progress = Progress.initial(jnp.full(value.shape, jnp.inf, value.dtype))
        return _StepwiseState(inner, jnp.array(_FRESH), progress)

    def evaluate(
        self, fn: Any, y: Any, args: Any, scales: Scales, state: _StepwiseState
    ) -> tuple[Any, _StepwiseState, None, Any]:
        value, aux = eqx.filter_eval_shape(fn, y, args)
        options = {"scales": scales}
        arrays, static = eqx.partition(state.inner, eqx.is_array)

        def restart() -> tuple[Any, Any]:
            fresh = self.solver.init(fn, y, args, options, value, aux, frozenset())
            old = self.solver.reevaluated(fresh, state.inner)
            return y, eqx.filter(tree_where(state.restart == _FRESH, fresh, old), eqx.is_array)

        def step() -> tuple[Any, Any]:
            inner = eqx.combine(arrays, static)
            new, inner, _ = self.solver.step(fn, y, args, options, inner, frozenset())
            return new, eqx.filter(inner, eqx.is_array)

        anew = state.restart != _NO
        y, arrays = jax.lax.cond(anew, restart, step)
        inner = eqx.combine(arrays, static)
        force, true = self.solver.norm(self.solver.gradient(inner)), jnp.array(True)
        return (
            y,
            _StepwiseState(inner, jnp.array(_NO), Progress(true, ~anew, ~anew, force)),
            None,
            aux,
        )

    def propose(
        self,
        model: None,
        scales: Scales,
        state: _StepwiseState,
        active: Bool[Array, ""],
        preconditioner: Any = None,
    ) -> _StepwiseState:
        return state

    def moved(
        self,
        state: _StepwiseState,
        fraction: Rows,
        flipped: Bool[Array, ""],
        changed: Bool[Array, ""],
        scales: Scales,
    ) -> _StepwiseState:
        # After transitions and shortened steps the memory of the solver (momentum, curvature) misleads.
        fresh = flipped | (jnp.asarray(tree.min(fraction)) < 1)
        restart = jnp.where(changed, jnp.where(fresh, _FRESH, _OLD), _NO)
        return eqx.tree_at(lambda s: s.restart, state, restart)

    def progress(self, state: _StepwiseState) -> Progress:
        return state.progress

    def gradient(self, state: _StepwiseState) -> PyTree[Float[Array, "..."]]:
        return self.solver.gradient(state.inner)


# Whether the next evaluation restarts the solver at the iterate: not, with its old memory, or without.
_NO, _OLD, _FRESH = range(3)
