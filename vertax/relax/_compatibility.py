"""Combinations of adjoints, solvers and transformations that a relaxation does not support."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

from vertax._base.checks import check_instance
from vertax._base.tracing import differs_between_devices
from vertax.adjoints import AbstractAdjoint, EquilibriumPropagation
from vertax.solvers import AbstractSolver, Wrapped


def check_adjoint(adjoint: Any, solver: AbstractSolver) -> None:
    """Raise an error for an adjoint that does not support the solver."""
    expected = "one of vertax.adjoints, e.g. ImplicitDifferentiation()"
    check_instance("adjoint", adjoint, AbstractAdjoint, expected)
    if adjoint.unrolls and not solver.unrollable:
        inner = solver.solver if isinstance(solver, Wrapped) else solver
        raise ValueError(
            f"{type(adjoint).__name__} differentiates the steps of the solver, which line searches and "
            f"inner loops do not allow, so it does not go with {type(inner).__name__}. Pass e.g. "
            "solver=vertax.solvers.GradientDescent() or Optax(optax.sgd(1e-2, momentum=0.9)), or "
            "keep the solver and use ImplicitDifferentiation or EquilibriumPropagation."
        )
    if isinstance(adjoint, EquilibriumPropagation) and adjoint.nudge == "cost":
        raise ValueError(
            "EquilibriumPropagation(nudge='cost') needs to know the cost: use it in an InverseProblem, "
            "or nudge='linear' here."
        )


def check_sharding(tree: PyTree) -> None:
    """Raise an error within a `jax.shard_map` that checks which values differ between devices."""
    # Within `shard_map` JAX distinguishes values that differ between devices, and refuses a loop that starts
    # at a constant 0, as the loops of Optimistix and Equinox do.
    if any(differs_between_devices(x) for x in jax.tree.leaves(tree) if eqx.is_array(x)):
        raise ValueError(
            "A relaxation within jax.shard_map needs jax.shard_map(..., check_vma=False): its loops begin "
            "with numbers that are the same on all devices."
        )
