"""What the epochs of all fits have in common: the best point so far, and where the next one starts."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from vertax._base.sequential_vmap import sequential_vmap_on_cpu
from vertax._base.tracing import tree_where
from vertax.fitting._history import Facts, Record
from vertax.fitting._inverse import InverseProblem
from vertax.mesh import Tissue


class Best(eqx.Module):
    """The parameters of lowest cost so far, and what belongs to them."""

    parameters: PyTree[Array]
    tissue: Tissue
    facts: Facts
    guidance: Float[Array, ""]
    epoch: Int[Array, ""]


def over_members(function: Callable[..., Any], problem: InverseProblem) -> Callable[..., Any]:
    """A function, which takes derivatives inside, of each member of a batch of problems."""
    batched = problem.response.prefers_batching
    return eqx.filter_vmap(function if batched else sequential_vmap_on_cpu(function))


class AbstractMethod(eqx.Module):
    """A way to fit, one epoch after another."""

    @abc.abstractmethod
    def start(self) -> Any:
        """The state before the first epoch: a pytree with `best`, and `going`, False once it is done."""

    @abc.abstractmethod
    def advance(self, state: Any, epoch: int) -> tuple[Any, Record]:
        """The state after an epoch, and what happened in it."""

    @abc.abstractmethod
    def description(self) -> str:
        """The optimiser in words, such that another one has others."""

    @abc.abstractmethod
    def strength(self, epoch: int) -> float:
        """Strength of the guidance in an epoch; NaN without any."""


def no_shift(problem: InverseProblem) -> Float[Array, "2"] | None:
    """Where a fitted position starts in each epoch; None if it is not fitted."""
    # It is counted from the last equilibrium: an update displaces the tissue, and is forgotten.
    return jnp.zeros(2, problem.tissue.vertices.dtype) if problem.fit_position else None


def nothing_known(problem: InverseProblem) -> Facts:
    """The facts of an epoch that has not happened."""
    dtype = problem.tissue.vertices.dtype
    unknown, none = jnp.full((), jnp.nan, dtype), jnp.zeros((), int)
    return Facts(
        cost=jnp.full((), jnp.inf, dtype),
        max_force=jnp.full((), jnp.inf, dtype),
        converged=jnp.array(False),
        num_steps=none,
        num_t1=none,
        gradient_norm=unknown,
        gradient_residual=unknown,
        gradient_steps=unknown,
        relative_error=unknown,
    )


def unbeaten(problem: InverseProblem, parameters: PyTree[Array]) -> Best:
    facts = nothing_known(problem)
    return Best(
        parameters, problem.tissue, facts, facts.cost, jnp.full((), -1, jnp.result_type(int))
    )


def better(
    best: Best,
    parameters: PyTree,
    tissue: Tissue,
    facts: Facts,
    guidance: Array,
    epoch: Array,
    ok: Array,
) -> Best:
    new = Best(parameters, tissue, facts, guidance, epoch)
    # Guidance makes any cost small: only costs at the same one can be compared.
    lower = (guidance < best.guidance) | (
        (guidance == best.guidance) & (facts.cost < best.facts.cost)
    )
    return tree_where(ok & lower, new, best)


def guidance_of(problem: InverseProblem) -> Float[Array, "*batch"]:
    return jnp.asarray(
        0 if problem.guidance is None else problem.guidance, problem.tissue.vertices.dtype
    )


def relative_error(parameters: PyTree[Array], true: PyTree[Array] | None) -> Float[Array, ""]:
    if true is None:
        return jnp.full_like(jax.tree.leaves(parameters)[0].ravel()[0], jnp.nan)
    errors = jax.tree.map(lambda p, q: jnp.ravel(jnp.abs(p - q) / jnp.abs(q)), parameters, true)
    return jnp.mean(jnp.concatenate(jax.tree.leaves(errors)))
