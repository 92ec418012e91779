"""A preconditioner for relaxations that end near one another: the inverse Hessian of one of them."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from vertax.precondition._coarse import AbstractCoarseLevel
from vertax.solvers._direct import as_matrix
from vertax.solvers._rows import Rows, row_inner, times

# Eigenvalues below this fraction of the mean stiffness are replaced by it: there are zero modes.
_SOFTEST = 1e-3
# If the root mean square displacement since then is larger, in units of the length scale, products with the
# inverse cost more time than they save.
_NEAR = 0.04


class RecycledHessian(AbstractCoarseLevel):
    """The inverse of the Hessian at a nearby equilibrium, for conjugate gradients and MINRES.

    Each epoch of a fit ends near the equilibrium of the last one, with almost the same Hessian. For small
    tissues the Hessian is inverted once in many epochs. The inverse is positive definite, so it changes the
    number of iterations, not the solution. It replaces the local part of a preconditioner.
    """

    inverse: Float[Array, "n n"]
    place: Float[Array, "vertices 2"]
    """The vertices of that equilibrium."""
    reach: Float[Array, ""]
    """The largest root mean square displacement from there."""
    usable: Bool[Array, ""]
    """Whether it has been computed, and can be used."""

    @classmethod
    def unknown(cls, configuration: PyTree[Array]) -> RecycledHessian:
        """A placeholder with the shapes of a configuration."""
        flat, _ = ravel_pytree(configuration)
        place = jax.tree.leaves(configuration)[0]
        nothing = jnp.zeros((flat.size, flat.size), flat.dtype)
        return cls(nothing, place, jnp.zeros((), flat.dtype), jnp.array(False))

    @classmethod
    def at(
        cls,
        hessian: Callable[[PyTree], PyTree],
        configuration: PyTree[Array],
        length: Float[Array, ""],
    ) -> RecycledHessian:
        """The inverse of the absolute value of the Hessian at a configuration.

        **Arguments:**

        - `hessian`: multiplies by the Hessian.
        - `configuration`: the configuration.
        - `length`: the length scale.
        """
        matrix = as_matrix(hessian, configuration)
        curvatures, motions = jnp.linalg.eigh(matrix)
        sizes = jnp.abs(curvatures)
        inverse = (motions / jnp.maximum(sizes, _SOFTEST * jnp.mean(sizes))) @ motions.T
        ready = jnp.all(jnp.isfinite(inverse))
        place = jax.tree.leaves(configuration)[0]
        return cls(jnp.where(ready, inverse, 0), place, _NEAR * length, ready)

    def near(self, configuration: PyTree[Array]) -> RecycledHessian:
        """A copy that is ready only if vertices have not moved far, apart from a common translation."""
        moved = jax.tree.leaves(configuration)[0] - self.place
        moved -= jnp.mean(moved, axis=0)
        near = jnp.mean(row_inner(moved, moved)) < self.reach**2
        return eqx.tree_at(lambda h: h.usable, self, self.usable & near)

    @property
    def ready(self) -> Bool[Array, ""]:
        return self.usable

    @property
    def blank(self) -> tuple[()]:
        return ()

    def set_up(self, hessian: Callable, like: PyTree, stiffness: Float[Array, ""]) -> tuple[()]:
        """No set-up is needed."""
        return ()

    def approximate_inverse(
        self,
        measured: tuple[()],
        damping: Float[Array, ""] | float = 0.0,
        shares: Rows | None = None,
    ) -> Rows | None:
        return None if shares is None else jax.tree.map(jnp.sqrt, shares)

    def apply(self, inverse: Rows | None, local: PyTree, force: PyTree) -> PyTree:
        share = lambda x: x if inverse is None else jax.tree.map(times, inverse, x)
        flat, unravel = ravel_pytree(share(force))
        return share(unravel(self.inverse @ flat))
