"""What every response of a tissue to its energy has in common."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.tracing import is_concrete
from vertax.adjoints import AbstractAdjoint
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue
from vertax.precondition._recycled_hessian import RecycledHessian


class Equilibrium(eqx.Module):
    """A relaxed tissue and how it got there; under `jax.vmap` one entry for each of the batch."""

    tissue: Tissue
    """The relaxed tissue, differentiable with respect to the parameters of the energy."""
    energy: Float[Array, "*batch"]
    """Its energy."""
    max_force: Float[Array, "*batch"]
    r"""Largest component of $|\nabla_X E|$."""
    num_steps: Int[Array, "*batch"]
    """Steps of the minimiser."""
    num_t1: Int[Array, "*batch"]
    """Transitions on the way: T1, and T2 if the rule has them."""
    valid: Bool[Array, "*batch"]
    """Whether its cells tile the plane; `tissue.overlaps` says where they do not."""
    result: optx.RESULTS
    """Outcome of the minimiser; `optimistix.RESULTS[result]` is its message."""

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the largest force fell below the tolerance, in a tissue without overlaps."""
        return (self.result == optx.RESULTS.successful) & self.valid

    def checked(self) -> Equilibrium:
        """The same, if it converged.

        **Raises:**

        - `RuntimeError` (of Equinox inside `jax.jit`) if it did not, or if cells overlap.
        """
        converged = self.converged
        if not is_concrete(converged):
            # A compiled program selects one of several messages, which cannot hold numbers. Of a batch the
            # message with the largest index is raised.
            messages = (
                f"The relaxation reached no equilibrium. {_REMEDY}",
                f"Cells of the relaxed tissue overlap. {_UNTANGLE}",
                f"The relaxation broke down: {_NOT_FINITE}",
            )
            which = jnp.where(jnp.isfinite(self.max_force), jnp.where(self.valid, 0, 1), 2)
            which = jnp.where(converged, 0, which)
            return eqx.branched_error_if(self, ~converged, which, messages)
        if np.all(converged):
            return self
        members = f" ({np.sum(~converged)} of {np.size(converged)})" if np.ndim(converged) else ""
        forces = np.asarray(self.max_force)
        if not np.isfinite(forces).all():
            raise RuntimeError(f"The relaxation broke down{members}: {_NOT_FINITE}")
        if not np.all(self.valid):
            raise RuntimeError(
                f"Cells of the relaxed tissue overlap{members}: {self._first_overlap()}. {_UNTANGLE}"
            )
        raise RuntimeError(
            f"The relaxation reached no equilibrium{members} in {np.max(self.num_steps)} steps (largest "
            f"force {np.max(forces):.1e}). {_REMEDY}"
        )

    def _first_overlap(self) -> str:
        """Where the first tissue of a batch overlaps that does."""
        ndim, number = np.ndim(self.valid), int(np.argmin(np.ravel(self.valid)))
        one = lambda x: x.reshape(-1, *x.shape[ndim:])[number] if eqx.is_array(x) else x
        return jax.tree.map(one, self.tissue).overlaps.describe()


_NOT_FINITE = (
    "its forces are not finite. The parameters of the energy must be finite, but may be NaN or infinity, or "
    "so extreme that the tissue collapses. Check them."
)
_UNTANGLE = (
    "A relaxation never makes cells overlap unless `contact_range` is None, but it may start from a tissue "
    "in which they do: look at its `overlaps`."
)
_REMEDY = (
    "Raise `max_steps`, loosen `tolerance`, use the default solver, or pass throw=False and look at "
    "`converged`."
)


class AbstractResponse(eqx.Module):
    """How a tissue answers to its energy."""

    @property
    def goes_on(self) -> bool:
        """Whether the next epoch of a fit may begin where this one ended, as it may at rest."""
        return True

    @abc.abstractmethod
    def __call__(
        self,
        tissue: Tissue,
        energy: AbstractEnergy,
        *,
        adjoint: AbstractAdjoint | None = None,
        throw: bool = True,
    ) -> Equilibrium:
        """Let the tissue answer.

        **Arguments:**

        - `tissue`: where it starts.
        - `energy`: what it answers to.
        - `adjoint`: how to differentiate.
        - `throw`: raise an error if it reaches no equilibrium.

        **Returns:** where it ends.
        """

    @property
    def prefers_batching(self) -> bool:
        """Whether a batch is faster in one batched call than one after another, also on a CPU."""
        return False

    def primal(self, tissue: Tissue, energy: AbstractEnergy) -> PyTree:
        """The part of the response that is not differentiated, which is compiled by itself.

        A fit, an equilibrium and a gradient that call it outside of `jax.jit` share the compiled function.

        **Arguments:**

        - `tissue`: where it starts.
        - `energy`: what it answers to.

        **Returns:** the first argument of `attach`; None if the response does not separate the two parts.
        """
        return None

    def attach(
        self, primal: PyTree, tissue: Tissue, energy: AbstractEnergy, adjoint: AbstractAdjoint
    ) -> Equilibrium:
        """The response as a differentiable function, where `primal` has led; nothing is raised.

        **Arguments:**

        - `primal`: the result of the method `primal` for these arguments.
        - `tissue`, `energy`, `adjoint`: as in a call of the response.

        **Returns:** as a call of the response.
        """
        return self(tissue, energy, adjoint=adjoint, throw=False)

    def goes_with(
        self, adjoint: AbstractAdjoint, *, guided: bool = False, placed: bool = False
    ) -> None:
        """Refuse an adjoint, or a cost that pulls the tissue, that this response has no use for.

        **Arguments:**

        - `adjoint`: how an inverse problem is to differentiate.
        - `guided`: whether its cost is to pull the tissue, see `guidance` there.
        - `placed`: whether it is to fit where the whole tissue lies.

        **Raises:**

        - `ValueError` with the reason, and with what to take instead.
        """

    def complaint(self) -> str | None:
        """What went wrong last, in words, if it keeps them."""
        return None

    def preconditioner_at(
        self, tissue: Tissue, energy: AbstractEnergy | None
    ) -> RecycledHessian | None:
        """A preconditioner for relaxations that end near this equilibrium; None where it would not help.

        **Arguments:**

        - `tissue`: a tissue at rest.
        - `energy`: its energy; None for what stands for a Hessian that is not known yet.
        """
        return None

    def with_preconditioner(self, hessian: RecycledHessian | None) -> AbstractResponse:
        """The same with the Hessian of an equilibrium near by, which makes it faster and nothing else."""
        return self

    @abc.abstractmethod
    def traced(self) -> AbstractResponse:
        """The same with its numbers as arrays, of which another one compiles nothing anew."""

    def completed(self, tissue: Tissue) -> AbstractResponse:
        """As `traced`, with all that is optional, so that one compiled function serves with and without."""
        return self.traced()

    @abc.abstractmethod
    def finer(self, tolerance: Float[Array, ""]) -> AbstractResponse:
        """The same, at rest only where the largest force is below this tolerance too."""
