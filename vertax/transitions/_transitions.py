"""What every rule for transitions has in common."""

from __future__ import annotations

import abc

import equinox as eqx
from jaxtyping import Array, Int

from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class AbstractTransitions(eqx.Module):
    """A rule by which a tissue changes its topology while it relaxes."""

    @abc.abstractmethod
    def init(self, tissue: Tissue) -> Int[Array, " edges"]:
        """How often each edge took part in a transition: never yet."""

    @abc.abstractmethod
    def sweep(
        self, tissue: Tissue, energy: AbstractEnergy, counts: Int[Array, " edges"]
    ) -> tuple[Tissue, Int[Array, " edges"]]:
        """Try every candidate once; returns the new tissue and the updated counts."""
