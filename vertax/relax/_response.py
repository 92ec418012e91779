"""The base class of relaxations and other responses, and their result."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.results import RESULTS, AbstractOutcome
from vertax.adjoints import AbstractAdjoint, ImplicitDifferentiation
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Equilibrium(AbstractOutcome):
    """A relaxed tissue; under `jax.vmap` with one entry for each of the batch."""

    tissue: Tissue
    """The relaxed tissue, differentiable with respect to the parameters of the energy."""
    energy: Float[Array, "*batch"]
    """Its energy."""
    max_force: Float[Array, "*batch"]
    r"""Largest component of $|\nabla_X E|$."""
    num_steps: Int[Array, "*batch"]
    """Steps of the minimiser."""
    num_t1: Int[Array, "*batch"]
    """Number of transitions: T1, and T2 if the rule has them."""
    result: RESULTS
    """How the relaxation ended; `vertax.RESULTS[result]` is the message. It is `successful` if the largest
    force fell below the tolerance, in a tissue without overlaps (`tissue.overlaps` says where they are)."""

    def _details(self) -> str:
        texts = [f"largest force {np.max(self.max_force):.1e} after {np.max(self.num_steps)} steps"]
        if np.any(self.result == RESULTS.overlap):
            texts.append(self.tissue.overlaps.describe())
        return "; ".join(texts)


def with_overlaps(result: RESULTS, overlaps: Bool[Array, ""]) -> RESULTS:
    """A result, or `overlap` if there are overlaps of finite cells unless it names their reason."""
    other = (result != RESULTS.nonfinite) & (result != RESULTS.no_progress)
    return RESULTS.where(overlaps & other, RESULTS.overlap, result)


class AbstractResponse(eqx.Module):
    """A map from a tissue and its energy to an equilibrium: a relaxation, a time step, another program."""

    @property
    def supports_warm_start(self) -> bool:
        """Whether the next epoch of a fit may start from the result of this one (warm start)."""
        return True

    @abc.abstractmethod
    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint = ImplicitDifferentiation(),
        throw: bool = True,
    ) -> Equilibrium:
        """The equilibrium.

        **Arguments:**

        - `tissue`: the initial tissue.
        - `energy`: its energy.
        - `adjoint`: how to differentiate.
        - `throw`: raise an error if no equilibrium is reached.
        """

    @property
    def prefers_batching(self) -> bool:
        """Whether a batch is faster in one batched call than one after another, also on a CPU."""
        return False

    def primal(self, tissue: Tissue, energy: AbstractEnergy) -> PyTree:
        """The part of the response that is not differentiated, which is compiled by itself.

        A fit, an equilibrium and a gradient that call it outside of `jax.jit` share the compiled function.

        **Arguments:**

        - `tissue`: the initial tissue.
        - `energy`: its energy.

        **Returns:** the first argument of `attach`; None if the response does not separate the two parts.
        """
        return None

    def attach(
        self, primal: PyTree, tissue: Tissue, energy: AbstractEnergy, adjoint: AbstractAdjoint
    ) -> Equilibrium:
        """The response as a differentiable function at the result of `primal`; no error is raised.

        **Arguments:**

        - `primal`: the result of the method `primal` for these arguments.
        - `tissue`, `energy`, `adjoint`: as in a call of the response.

        **Returns:** as a call of the response.
        """
        return self(tissue, energy, adjoint=adjoint, throw=False)

    def check_compatible(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Raise an error for an adjoint, or a guiding cost, that this response does not support.

        **Arguments:**

        - `adjoint`: the adjoint of an inverse problem.
        - `guided`: whether its cost pulls the tissue, see `guidance` there.
        - `placed`: whether it fits the position of the tissue.

        **Raises:**

        - `ValueError` with the reason, and with what to take instead.
        """

    def last_error_message(self) -> str | None:
        """The message of the last error, if it is kept."""
        return None

    @abc.abstractmethod
    def traced(self) -> AbstractResponse:
        """A copy with its numbers as arrays: another number compiles nothing."""

    @abc.abstractmethod
    def finer(self, tolerance: Float[Array, ""]) -> AbstractResponse:
        """A copy with a tolerance that is at most this one."""
