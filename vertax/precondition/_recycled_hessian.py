"""A preconditioner for relaxations that come to rest near one another: the Hessian of one of them."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from vertax.solvers._direct import as_matrix
from vertax.solvers._rows import Rows, row_inner, times

# No motion is taken to be softer than this, in units of the mean stiffness: some cost nothing, or next to it.
_SOFTEST = 1e-3
# Where vertices are further from where they were then, typically, products with the inverse cost more time
# than they save; in units of the length scale.
_NEAR = 0.04


class RecycledHessian(eqx.Module):
    """The inverse of a Hessian that is not far from the one at hand, for conjugate gradients and MINRES.

    In a fit each epoch comes to rest near the last one, with almost the same Hessian, which a small tissue
    can afford to invert once in many epochs. It is positive definite, or not known: so it changes the number
    of steps and not where they lead, however far the Hessian has gone meanwhile.
    """

    inverse: Float[Array, "n n"]
    place: Float[Array, "vertices 2"]
    """Where vertices were then."""
    reach: Float[Array, ""]
    """How far they may be from there."""
    ready: Bool[Array, ""]
    """Whether it is known at all, and of use."""

    @classmethod
    def unknown(cls, configuration: PyTree[Array]) -> RecycledHessian:
        """That of a configuration of which nothing is known yet."""
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
        """The one of a configuration; what has negative curvature counts as what has positive.

        **Arguments:**

        - `hessian`: multiplies by it.
        - `configuration`: where it is.
        - `length`: the length scale.
        """
        matrix = as_matrix(hessian, configuration)
        curvatures, motions = jnp.linalg.eigh(matrix)
        sizes = jnp.abs(curvatures)
        inverse = (motions / jnp.maximum(sizes, _SOFTEST * jnp.mean(sizes))) @ motions.T
        ready = jnp.all(jnp.isfinite(inverse))
        place = jax.tree.leaves(configuration)[0]
        return cls(jnp.where(ready, inverse, 0), place, _NEAR * length, ready)

    def seen_from(self, configuration: PyTree[Array]) -> RecycledHessian:
        """The same, and not ready if vertices have moved far, other than all together."""
        moved = jax.tree.leaves(configuration)[0] - self.place
        moved -= jnp.mean(moved, axis=0)
        near = jnp.mean(row_inner(moved, moved)) < self.reach**2
        return eqx.tree_at(lambda h: h.ready, self, self.ready & near)

    @property
    def unmeasured(self) -> tuple[()]:
        return ()

    def measured(self, hessian: Callable, like: PyTree, mean: Float[Array, ""]) -> tuple[()]:
        """Nothing, for it is known."""
        return ()

    def compliance(
        self,
        measured: tuple[()],
        shift: Float[Array, ""] | float = 0.0,
        shares: Rows | None = None,
    ) -> Rows | None:
        """What `added` needs if each row hands on a share of its force, and moves as much; all by default."""
        return None if shares is None else jax.tree.map(jnp.sqrt, shares)

    def added(self, roots: Rows | None, near: PyTree, force: PyTree) -> PyTree:
        """The response to a force, in place of that of what is `near`."""
        share = lambda x: x if roots is None else jax.tree.map(times, roots, x)
        flat, unravel = ravel_pytree(share(force))
        return share(unravel(self.inverse @ flat))
