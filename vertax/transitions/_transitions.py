"""The interface of rules for transitions, and sequences of rules."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractTransitions(eqx.Module):
    """A rule for changes of topology during a relaxation.

    Rules can be added: `T1() + T2()` makes one sweep of each, in this order.
    """

    @abc.abstractmethod
    def init(self, tissue: Tissue) -> Int[Array, "*rules edges"]:
        """Zero counts of transitions for each edge."""

    @abc.abstractmethod
    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, "*rules edges"],
        allowed: Bool[Array, " edges"] | bool = True,
    ) -> tuple[Tissue, Int[Array, "*rules edges"]]:
        """Try every candidate once.

        **Arguments:**

        - `tissue`: the tissue.
        - `energy`: its energy, by which candidates are accepted or rejected.
        - `counts`: number of transitions of each edge.
        - `allowed`: which edges may flip. A relaxation excludes those that would cause overlaps.

        **Returns:** the new tissue and the updated counts.
        """

    def __add__(self, other: AbstractTransitions) -> AbstractTransitions:
        """A sweep of this rule, then one of the other."""
        if not isinstance(other, AbstractTransitions):
            return NotImplemented
        return InTurn((*_rules(self), *_rules(other)))


class InTurn(AbstractTransitions):
    """A sequence of rules, made by `+`: a sweep makes one sweep of each rule."""

    rules: tuple[AbstractTransitions, ...]

    def init(self, tissue: Tissue) -> Int[Array, "rules edges"]:
        """Zero counts of transitions for each rule and edge."""
        return jnp.stack([rule.init(tissue) for rule in self.rules])

    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, "rules edges"],
        allowed: Bool[Array, " edges"] | bool = True,
    ) -> tuple[Tissue, Int[Array, "rules edges"]]:
        """Make one sweep of each rule; return the new tissue and the updated counts."""
        updated = []
        for rule, old in zip(self.rules, counts, strict=True):
            tissue, new = rule.sweep(tissue, energy, old, allowed)
            updated.append(new)
        return tissue, jnp.stack(updated)


def _rules(transitions: AbstractTransitions) -> tuple[AbstractTransitions, ...]:
    return transitions.rules if isinstance(transitions, InTurn) else (transitions,)
