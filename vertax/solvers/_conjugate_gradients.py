"""Conjugate gradients for a step within bounds."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from vertax._base.reductions import max_of
from vertax._base.rows import Table, inner, row_inner, sizes
from vertax._base.tracing import zeros_of


class Proposal(NamedTuple):
    """A step within bounds."""

    step: Table
    product: Table
    """Of the step with the Hessian."""
    damping: Float[Array, " rows"]
    num_products: Int[Array, ""]


class AbstractInverse(eqx.Module):
    """An approximate inverse of a damped Hessian, symmetric and positive definite."""

    @abc.abstractmethod
    def factors(self, damping: Float[Array, " rows"]) -> PyTree[Array]:
        """What is computed once for a damping."""

    @abc.abstractmethod
    def apply(self, factors: PyTree[Array], residual: Table) -> Table:
        """The product with a residual."""


class DiagonalInverse(AbstractInverse):
    """$1 / (k + \\lambda)$ with the stiffness $k$ and the damping $\\lambda$ of each row."""

    stiffness: Float[Array, ""] | float

    def factors(self, damping: Float[Array, " rows"]) -> Float[Array, " rows"]:
        return damping

    def apply(self, factors: Float[Array, " rows"], residual: Table) -> Table:
        return residual / (self.stiffness + factors)[:, None]


class _State(NamedTuple):
    step: Table
    residual: Table
    """$g + (H + \\Lambda) p$"""
    direction: Table
    """The last one."""
    last: Float[Array, ""]
    """The squared norm of the last residual; 0 where the iteration begins anew."""
    first: Float[Array, ""]
    """The squared norm of the first residual."""
    furthest: Float[Array, ""]
    """The length of the longest row of the step, in units of its bound."""
    curvature: Float[Array, ""]
    """$d \\cdot (H + \\Lambda) d$ of the last direction."""
    damping: Float[Array, " rows"]
    factors: PyTree[Array]
    done: Bool[Array, ""]
    num_products: Int[Array, ""]
    num_rounds: Int[Array, ""]


class _System(NamedTuple):
    """The arguments that all iterations of one step share."""

    product: Callable[[Table], Table]
    inverse_bounds: Float[Array, "rows 1"]
    inverse: AbstractInverse
    forcing: Float[Array, ""]
    max_products: int | Int[Array, ""]

    def furthest(self, step: Table) -> Float[Array, ""]:
        """The length of the longest row, in units of its bound."""
        return max_of(sizes(step * self.inverse_bounds))


class _Direction(NamedTuple):
    """The direction of an iteration."""

    vector: Table
    product: Table
    """With the Hessian."""
    damped: Table
    """With the Hessian and the damping."""
    squared: Float[Array, ""]
    """The squared norm of the residual, $r \\cdot z$."""
    small: Bool[Array, ""]
    """Whether the residual is small enough: the direction is not used then."""


class TruncatedCG(eqx.Module):
    r"""Solves $(H + \Lambda) p = -g$ by conjugate gradients, with bounds for the rows of $p$.

    $\Lambda$ is diagonal, with one number for each row.

    1. Iterate until the residual, in the norm of the preconditioner, is below `forcing` times the first one.
    2. Where a row would become longer than `overshoot` times its bound (at the end: `overshoot_solved`), or
        the curvature along a direction is negative, increase $\Lambda$ there, and begin anew from the current
        step; at most `max_rounds` times.

    (Steihaug 1983, doi:10.1137/0720042; Nocedal & Wright 2006, alg. 7.2, doi:10.1007/978-0-387-40065-5.)
    """

    overshoot: float = 4.0
    overshoot_solved: float = 1.5
    max_rounds: int = 8

    def __call__(
        self,
        product: Callable[[Table], Table],
        gradient: Table,
        damping: Float[Array, " rows"],
        bounds: Float[Array, " rows"],
        inverse: AbstractInverse,
        forcing: Float[Array, ""],
        max_products: int | Int[Array, ""],
        active: Bool[Array, ""],
    ) -> Proposal:
        """The step.

        **Arguments:**

        - `product`: multiplies by the Hessian.
        - `gradient`: the gradient $g$.
        - `damping`: the diagonal of $\\Lambda$ to begin with.
        - `bounds`: about how long each row may become.
        - `inverse`: the preconditioner.
        - `forcing`: the residual at the end, relative to the first one.
        - `max_products`: most products with the Hessian.
        - `active`: whether to do anything; otherwise the step is zero.
        """
        system = _System(product, 1 / bounds[:, None], inverse, forcing, max_products)
        zero, number, scalar = jnp.zeros_like(gradient), jnp.array(0), jnp.zeros((), gradient.dtype)
        begin = _State(
            step=zero,
            residual=gradient,
            direction=zero,
            last=scalar,
            first=scalar,
            furthest=scalar,
            curvature=scalar,
            damping=damping,
            factors=zeros_of(jax.eval_shape(inverse.factors, damping)),
            done=~active | (inner(gradient, gradient) == 0),
            num_products=number,
            num_rounds=number,
        )
        iterate = lambda s: self._iterate(system, s)
        end = jax.lax.while_loop(lambda s: ~s.done, iterate, begin)
        hp = end.residual - gradient - end.damping[:, None] * end.step
        return Proposal(end.step, hp, end.damping, end.num_products)

    def _iterate(self, system: _System, s: _State) -> _State:
        """One iteration."""
        s, d = self._next_direction(system, s)
        small = d.small
        curvature = inner(d.vector, d.damped)
        more = s.num_rounds < self.max_rounds
        convex = curvature > 0
        concave = ~small & ~convex
        length = jnp.where(convex & ~small, d.squared / jnp.where(convex, curvature, 1), 0)
        # (Along a negative curvature: to the bounds.)
        length = jnp.where(concave & ~more, 1, length)
        furthest = system.furthest(s.step + length * d.vector)
        beyond = ~small & more & (furthest > self.overshoot)
        # (Not further than the limit: where there is hardly any curvature that may be very far.)
        tiny = jnp.finfo(furthest.dtype).tiny
        room = (self.overshoot - s.furthest) / jnp.maximum(furthest - s.furthest, tiny)
        taken = length * jnp.where(beyond, jnp.clip(room, 0, 1), 1)
        # More damping where the step is too long or the curvature negative.
        far = furthest > jnp.where(small, self.overshoot_solved, self.overshoot)
        wants = concave | far
        again = wants & more
        after = s._replace(
            step=s.step + taken * d.vector,
            residual=s.residual + taken * d.damped,
            direction=d.vector,
            last=jnp.where(again, 0, d.squared),
            furthest=jnp.where(beyond, self.overshoot, furthest),
            curvature=jnp.where(small, s.curvature, curvature),
            num_products=s.num_products + jnp.where(small, 0, 1),
            num_rounds=s.num_rounds + again,
        )

        def damp() -> tuple[Table, Float[Array, " rows"]]:
            tried, last = s.step + length * d.vector, jnp.where(small, s.direction, d.vector)
            return self._with_damping(system, after, d, tried, concave, last)

        residual, damping = jax.lax.cond(again, damp, lambda: (after.residual, s.damping))
        ends = ((small | wants) & ~again) | (after.num_products >= system.max_products)
        return after._replace(residual=residual, damping=damping, done=ends)

    def _next_direction(self, system: _System, s: _State) -> tuple[_State, _Direction]:
        """The conjugate direction of the residual."""
        fresh = s.last == 0
        inverse, factors = system.inverse, s.damping
        if not isinstance(inverse, DiagonalInverse):
            build = lambda: inverse.factors(s.damping)
            factors = jax.lax.cond(fresh, build, lambda: s.factors)
        z = inverse.apply(factors, s.residual)
        squared = inner(s.residual, z)
        # (More damping makes a residual smaller; without a step that is no progress.)
        no_step = s.furthest == 0
        first = jnp.where(no_step, squared, s.first)
        small = ~no_step & (squared <= system.forcing**2 * first)
        beta = jnp.where(fresh, 0, squared / jnp.where(fresh, 1, s.last))
        vector = beta * s.direction - z
        product = jax.lax.cond(small, jnp.zeros_like, system.product, vector)
        damped = product + s.damping[:, None] * vector
        direction = _Direction(vector, product, damped, squared, small)
        return s._replace(first=first, factors=factors), direction

    def _with_damping(
        self,
        system: _System,
        s: _State,
        d: _Direction,
        tried: Table,
        concave: Bool[Array, ""],
        last: Table,
    ) -> tuple[Table, Float[Array, " rows"]]:
        """The residual and the damping after an increase of the damping.

        Rows of the `tried` step beyond their bounds get more in proportion to their length; where the
        curvature is negative, rows get twice their share of it.
        """
        tiny = jnp.finfo(s.damping.dtype).tiny
        rayleigh = s.curvature / jnp.maximum(inner(last, last), tiny)
        reached = sizes(tried * system.inverse_bounds)
        tighter = jnp.maximum(reached - 1, 0) * (s.damping + rayleigh)
        concavity = -jnp.minimum(row_inner(d.vector, d.product), 0)
        negative = 2 * concavity / jnp.maximum(row_inner(d.vector, d.vector), tiny)
        extra = jnp.where(concave, negative, tighter)
        return s.residual + extra[:, None] * s.step, s.damping + extra
