"""Implicit differentiation at equilibrium."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import lineax as lx
import optimistix as optx
from jaxtyping import PyTree

from vertax.adjoints._adjoint import AbstractAdjoint
from vertax.solvers import MINRES


class ImplicitDifferentiation(AbstractAdjoint):
    r"""Gradients through an equilibrium by the implicit function theorem (paper, Methods, "ID").

    At equilibrium $\nabla_X E(X^*, \theta) = 0$, so the equilibrium moves with its parameters as

    $$\frac{dX^*}{d\theta} = -H^{-1}\, \nabla^2_{X\theta} E, \qquad H = \nabla^2_X E.$$

    Reverse mode solves one linear system with $H$, whatever the number of parameters (the adjoint-state
    form); memory does not grow with the number of relaxation steps. The equilibrium must be a true one:
    an error $g$ in the force leaves an error of order $H^{-1} g$ in the gradient.

    **Arguments:**

    - `linear_solver`: solves the systems with the Hessian, which is symmetric and may be indefinite.
    """

    linear_solver: lx.AbstractLinearSolver = eqx.field(default_factory=MINRES)

    def apply(
        self,
        primal_fn: Callable,
        rewrite_fn: Callable,
        inputs: PyTree,
        tags: frozenset[object],
    ) -> PyTree[Any]:
        implicit = optx.ImplicitAdjoint(linear_solver=self.linear_solver)
        return implicit.apply(primal_fn, rewrite_fn, inputs, tags | {lx.symmetric_tag})
