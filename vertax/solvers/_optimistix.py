"""Minimisers of Optimistix, extended by the gradient at each step."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import optax
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from vertax._base.checks import describe
from vertax.solvers._first_order import has_line_search
from vertax.solvers._solver import AbstractSolver, value_and_gradient


class _WrappedState(eqx.Module):
    inner: PyTree
    gradient: PyTree[Float[Array, "..."]]


def check_solver(solver: Any) -> None:
    """Raise a `TypeError` with a remedy unless the argument is a minimiser."""
    if isinstance(solver, optx.AbstractMinimiser):
        return
    remedy = "Pass one of vertax.solvers, such as LBFGS(), or a minimiser of Optimistix."
    if isinstance(solver, type) and issubclass(solver, optx.AbstractMinimiser):
        remedy = f"Call it: {solver.__name__}(…)."
    elif isinstance(solver, optax.GradientTransformation):
        remedy = "Wrap the Optax optimiser: vertax.solvers.Optax(optimiser)."
    elif isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractRootFinder):
        remedy = f"{type(solver).__name__} solves another kind of problem. {remedy}"
    raise TypeError(f"Argument `solver` must be a minimiser, but is {describe(solver)}. {remedy}")


class Wrapped(AbstractSolver):
    """A minimiser of Optimistix, with convergence by the largest force.

    [`equilibrate`][vertax.equilibrate] wraps Optimistix minimisers automatically. The termination test of the
    minimiser is ignored. The force costs one gradient per step, except for quasi-Newton minimisers, which
    store it in their state.

    **Arguments:**

    - `solver`: any `optimistix.AbstractMinimiser`, e.g. `optimistix.BFGS(rtol=0.0, atol=0.0)`.

    **Raises:**

    - `TypeError` for anything else.
    """

    solver: optx.AbstractMinimiser[Any, Any, Any]

    def __check_init__(self):
        check_solver(self.solver)

    @property
    def unrollable(self) -> bool:
        if isinstance(self.solver, optx.OptaxMinimiser):
            return not has_line_search(self.solver.optim)
        return isinstance(self.solver, optx.GradientDescent)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _WrappedState:
        inner = self.solver.init(fn, y, args, options, f_struct, aux_struct, tags)
        return _WrappedState(inner, value_and_gradient(fn, y, args)[1])

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _WrappedState, tags: Any
    ) -> tuple[Any, _WrappedState, Any]:
        old = (y, state.inner)
        *new, aux = self.solver.step(fn, y, args, options, state.inner, tags)
        y, inner = _as_precise_as(old, tuple(new))
        if isinstance(self.solver, optx.AbstractQuasiNewton):
            gradient = inner.f_info.grad  # of the last accepted point, which is the one returned
        else:
            gradient = value_and_gradient(fn, y, args)[1]
        return y, _WrappedState(inner, gradient), aux

    def gradient(self, state: _WrappedState) -> PyTree[Float[Array, "..."]]:
        return state.gradient


def _as_precise_as(old: PyTree, new: PyTree) -> PyTree:
    """New values in the dtypes of the old ones, because some minimisers promote float32 to float64."""

    def cast(a: Any, b: Any) -> Any:
        return b.astype(a.dtype) if eqx.is_inexact_array(a) and eqx.is_inexact_array(b) else b

    return jax.tree.map(cast, old, new)
