"""What every rule for transitions has in common."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractTransitions(eqx.Module):
    """A rule by which a tissue changes its topology while it relaxes.

    Rules add: `T1() + T2()` is one sweep of each, in this order.
    """

    @abc.abstractmethod
    def init(self, tissue: Tissue) -> Int[Array, "*rules edges"]:
        """How often each edge took part in a transition: never yet."""

    @abc.abstractmethod
    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, "*rules edges"],
        length_fraction: Float[Array, " edges"] | float = 1.0,
    ) -> tuple[Tissue, Int[Array, "*rules edges"]]:
        """Try every candidate once.

        **Arguments:**

        - `tissue`: the tissue.
        - `energy`: its energy, which decides.
        - `counts`: how often each edge took part in a transition.
        - `length_fraction`: new edges have this fraction of their usual length; an edge of fraction 0 does
            not flip. A relaxation shortens new edges that make cells overlap.

        **Returns:** the new tissue and the updated counts.
        """

    def __add__(self, other: AbstractTransitions) -> AbstractTransitions:
        """Both rules, one after the other."""
        if not isinstance(other, AbstractTransitions):
            return NotImplemented
        return InTurn((*_rules(self), *_rules(other)))


class InTurn(AbstractTransitions):
    """Some rules, one sweep of each after the other; made by `+`."""

    rules: tuple[AbstractTransitions, ...]

    def init(self, tissue: Tissue) -> Int[Array, "rules edges"]:
        """How often each edge took part in a transition by each rule: never yet."""
        return jnp.stack([rule.init(tissue) for rule in self.rules])

    def sweep(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        counts: Int[Array, "rules edges"],
        length_fraction: Float[Array, " edges"] | float = 1.0,
    ) -> tuple[Tissue, Int[Array, "rules edges"]]:
        """A sweep of each; returns the new tissue and the updated counts."""
        updated = []
        for rule, own in zip(self.rules, counts, strict=True):
            tissue, own = rule.sweep(tissue, energy, own, length_fraction)
            updated.append(own)
        return tissue, jnp.stack(updated)


def _rules(transitions: AbstractTransitions) -> tuple[AbstractTransitions, ...]:
    return transitions.rules if isinstance(transitions, InTurn) else (transitions,)
