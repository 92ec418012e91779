"""Approximate inverses of the Hessian of a tissue, for conjugate gradients and MINRES."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from vertax._base.rows import Table, point_of, rows_of, table_of, times
from vertax.precondition._edge_blocks import EdgeBlocks
from vertax.precondition._elastic_medium import ElasticMedium
from vertax.solvers._conjugate_gradients import AbstractInverse


class Preconditioner(eqx.Module):
    r"""The sum of two approximate inverses of the Hessian: a local and a coarse one.

    1. Local: the edges, each with its two ends ([`EdgeBlocks`]), or else the diagonal
        $1 / (k + \lambda)$ with the mean stiffness $k$ and the damping $\lambda$ of a vertex.
    2. Coarse: an elastic medium ([`ElasticMedium`]). It is used only near an equilibrium: elsewhere soft
        modes may have negative curvature.

    It is positive definite whatever the Hessian is: it changes the number of iterations, not the solution.
    """

    edges: EdgeBlocks | None
    coarse: ElasticMedium | None

    @property
    def is_diagonal(self) -> bool:
        """Whether it is the diagonal alone."""
        return self.edges is None and self.coarse is None

    def inverse(
        self,
        product: Callable[[PyTree], PyTree],
        like: PyTree,
        stiffness: Float[Array, ""],
        coarse: Bool[Array, ""],
    ) -> TissueInverse:
        """The approximate inverse of the damped Hessian.

        **Arguments:**

        - `product`: multiplies by the Hessian.
        - `like`: a gradient.
        - `stiffness`: the mean stiffness.
        - `coarse`: whether to use the coarse part.
        """
        medium: Any = None
        if self.coarse is not None:
            level = self.coarse
            measure = lambda: level.set_up(product, like, stiffness)
            medium = jax.lax.cond(coarse, measure, lambda: level.blank)
        return TissueInverse(self, medium, stiffness, coarse, like)


class TissueInverse(AbstractInverse):
    """The approximate inverse of the damped Hessian of a tissue, see `Preconditioner`."""

    preconditioner: Preconditioner
    medium: Any
    stiffness: Float[Array, ""]
    coarse: Bool[Array, ""]
    like: PyTree

    def factors(self, damping: Float[Array, " rows"]) -> PyTree[Array]:
        rows, stiffness = rows_of(damping, self.like), self.stiffness
        yielding = jax.tree.map(lambda s: 1 / (stiffness + s), rows)
        of_vertices = jax.tree.leaves(rows)[0]
        edges, coarse = self.preconditioner.edges, self.preconditioner.coarse
        local: Any = yielding if edges is None else edges.approximate_inverse(of_vertices)
        if coarse is None:
            return local, None
        # A vertex that is held tightly must not hold the others, nor move them.
        held = jnp.mean(jnp.minimum(of_vertices, stiffness))
        shares = jax.tree.map(lambda y: stiffness * y, yielding)
        return local, coarse.approximate_inverse(self.medium, held, shares)

    def apply(self, factors: PyTree[Array], residual: Table) -> Table:
        local, medium = factors
        r = point_of(residual, self.like)
        diagonal = self.preconditioner.edges is None
        z = jax.tree.map(times, local, r) if diagonal else local(r)
        coarse = self.preconditioner.coarse
        if coarse is not None:
            z = jax.lax.cond(self.coarse, lambda: coarse.apply(medium, z, r), lambda: z)
        return table_of(z)
