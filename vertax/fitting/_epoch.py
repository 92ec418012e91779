"""Shared parts of all fit methods: the abstract method, the best parameters so far, and the errors."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import tree_where
from vertax.fitting._history import MISSING, Facts, Record
from vertax.fitting._inverse import InverseProblem
from vertax.mesh import Tissue


class Best(eqx.Module):
    """The parameters of lowest cost so far, with their equilibrium, record, guidance and epoch."""

    parameters: PyTree[Array]
    tissue: Tissue
    facts: Facts
    guidance: Float[Array | np.ndarray, ""]
    epoch: Int[Array | np.ndarray, ""]


def first_line(error: Exception) -> str:
    """The first line of the message of an error, without a full stop; its type if it has none."""
    lines = (line.strip(" .") for line in str(error).splitlines())
    return next((line for line in lines if line), type(error).__name__)


def over_members(function: Callable[..., Any], problem: InverseProblem) -> Callable[..., Any]:
    """Map a function that takes derivatives over the members of a batch of problems."""
    batched = problem.response.prefers_batching
    return eqx.filter_vmap(function if batched else sequential_vmap_on_cpu(function))


class AbstractMethod(eqx.Module):
    """A fit method, which advances by one epoch at a time."""

    @abc.abstractmethod
    def start(self) -> Any:
        """The initial state: a pytree with `best`, `active` (False when the fit has ended) and `result`."""

    @abc.abstractmethod
    def advance(self, state: Any, epoch: int) -> tuple[Any, Record]:
        """The state after an epoch, and the record of the epoch."""

    @abc.abstractmethod
    def first_epoch(self) -> Any:
        """What the first epoch computes for the tissue; traceable, to compare fits."""

    @abc.abstractmethod
    def description(self) -> str:
        """A text that identifies the optimiser and its settings, for checkpoints."""

    @abc.abstractmethod
    def strength(self, epoch: int) -> float:
        """Strength of the guidance in an epoch; NaN without guidance."""


def no_shift(problem: InverseProblem) -> Float[Array, "2"] | None:
    """The displacement at the start of each epoch, 0; None if the position is not fitted."""
    # The displacement is relative to the last equilibrium: an update moves the tissue and resets it to 0.
    return jnp.zeros(2, problem.tissue.vertices.dtype) if problem.fit_position else None


def nothing_known(problem: InverseProblem) -> Facts:
    """Placeholder facts before the first epoch, with infinite cost."""
    dtype = problem.tissue.vertices.dtype
    missing, zero = jnp.full((), MISSING, dtype), jnp.zeros((), int)
    return Facts(
        cost=jnp.full((), jnp.inf, dtype),
        max_force=jnp.full((), jnp.inf, dtype),
        converged=jnp.array(False),
        num_steps=zero,
        num_t1=zero,
        gradient_norm=missing,
        gradient_residual=missing,
        gradient_steps=missing,
        relative_error=missing,
    )


def unbeaten(problem: InverseProblem, parameters: PyTree[Array]) -> Best:
    """Placeholder before the first epoch, with infinite cost and epoch -1."""
    facts = nothing_known(problem)
    return Best(
        parameters, problem.tissue, facts, facts.cost, jnp.full((), -1, jnp.result_type(int))
    )


def better(
    best: Best,
    parameters: PyTree,
    tissue: Tissue,
    facts: Facts,
    guidance: Array | np.ndarray,
    epoch: Array | np.ndarray,
    ok: Array,
) -> Best:
    """The better of the previous best and a new candidate, which counts only if `ok`."""
    new = Best(parameters, tissue, facts, guidance, epoch)
    # Guidance lowers the cost for any parameters: prefer weaker guidance, compare costs at equal guidance.
    lower = (guidance < best.guidance) | (
        (guidance == best.guidance) & (facts.cost < best.facts.cost)
    )
    return tree_where(ok & lower, new, best)


def guidance_of(problem: InverseProblem) -> Float[Array | np.ndarray, "*batch"]:
    """Strength of the guidance of a problem; 0 without guidance."""
    dtype = problem.tissue.vertices.dtype
    # (A NumPy array takes no time of the device.)
    return np.zeros((), dtype) if problem.guidance is None else jnp.asarray(problem.guidance, dtype)


def relative_error(parameters: PyTree[Array], true: PyTree[Array] | None) -> Float[Array, ""]:
    """Mean of |inferred - true| / |true|; `MISSING` if the true parameters are not given."""
    if true is None:
        return jnp.full_like(jax.tree.leaves(parameters)[0].ravel()[0], MISSING)
    errors = jax.tree.map(lambda p, q: jnp.ravel(jnp.abs(p - q) / jnp.abs(q)), parameters, true)
    return jnp.mean(jnp.concatenate(jax.tree.leaves(errors)))
