"""What the epochs of all fits have in common: the best point so far, and where the next one starts."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax.fitting._history import Record
from vertax.fitting._inverse import InverseProblem
from vertax.mesh import Tissue


class Best(eqx.Module):
    """The parameters of lowest cost so far, and what belongs to them."""

    parameters: PyTree[Array]
    tissue: Tissue
    cost: Float[Array, ""]
    max_force: Float[Array, ""]
    guidance: Float[Array, ""]
    epoch: Int[Array, ""]


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


def unbeaten(problem: InverseProblem, parameters: PyTree[Array]) -> Best:
    infinite = jnp.asarray(jnp.inf, problem.tissue.vertices.dtype)
    return Best(parameters, problem.tissue, infinite, infinite, infinite, jnp.array(-1))


def better(
    best: Best,
    parameters: PyTree,
    tissue: Tissue,
    cost: Array,
    force: Array,
    guidance: Array,
    epoch: Array,
    ok: Array,
) -> Best:
    new = Best(parameters, tissue, cost, force, guidance, epoch)
    # Guidance makes any cost small: only costs at the same one can be compared.
    lower = (guidance < best.guidance) | ((guidance == best.guidance) & (cost < best.cost))
    return choose(ok & lower, new, best)


def guidance_of(problem: InverseProblem) -> Float[Array, ""]:
    return jnp.asarray(
        0 if problem.guidance is None else problem.guidance, problem.tissue.vertices.dtype
    )


def choose(condition: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    pick = lambda a, b: jnp.where(condition, a, b) if eqx.is_array(a) else a
    return jax.tree.map(pick, new, old)


def relative_error(parameters: PyTree[Array], true: PyTree[Array] | None) -> Float[Array, ""]:
    if true is None:
        return jnp.full_like(jax.tree.leaves(parameters)[0].ravel()[0], jnp.nan)
    errors = jax.tree.map(lambda p, q: jnp.ravel(jnp.abs(p - q) / jnp.abs(q)), parameters, true)
    return jnp.mean(jnp.concatenate(jax.tree.leaves(errors)))
