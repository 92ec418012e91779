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
from vertax._base.tracing import zeros_of
from vertax.solvers._rows import Table, inner, row_inner, sizes

# The phases of the loop: conjugate gradients, a last pass that clips the step, and the end.
_SOLVE, _CLIP, _END = range(3)


class Proposal(NamedTuple):
    """A step within bounds."""

    step: Table
    product: Table
    """Of the step with the Hessian."""
    damping: Float[Array, " rows"]
    curvature: Float[Array, ""]
    """$d \\cdot (H + \\Lambda) d$ of the last direction of conjugate gradients."""
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
    phase: Int[Array, ""]
    num_products: Int[Array, ""]
    num_rounds: Int[Array, ""]


class TruncatedCG(eqx.Module):
    r"""Solves $(H + \Lambda) p = -g$ by conjugate gradients, with bounds for the rows of $p$.

    $\Lambda$ is diagonal, with one number for each row.

    1. Iterate until the residual, in the norm of the preconditioner, is below `forcing` times the first one.
    2. Where a row would become longer than `overshoot` times its bound (at the end: `overshoot_solved`), or
        the curvature along a direction is negative, increase $\Lambda$ there, and begin anew from the current
        step; at most `max_rounds` times.
    3. Clip the rows that are longer than `clip` times their bound.

    (Steihaug 1983, doi:10.1137/0720042; Nocedal & Wright 2006, alg. 7.2, doi:10.1007/978-0-387-40065-5.)
    """

    overshoot: float = 4.0
    overshoot_solved: float = 1.5
    clip: float = 2.0
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
        apart = 1 / bounds[:, None]
        tiny = jnp.finfo(gradient.dtype).tiny

        def iterate(s: _State) -> _State:
            fresh, clips = s.last == 0, s.phase == _CLIP
            factors = s.factors
            if not isinstance(inverse, DiagonalInverse):
                build = lambda: inverse.factors(s.damping)
                factors = jax.lax.cond(fresh & ~clips, build, lambda: s.factors)
            else:
                factors = s.damping
            z = inverse.apply(factors, s.residual)
            rz = inner(s.residual, z)
            # (More damping makes a residual smaller; without a step that is no progress.)
            no_step = s.furthest == 0
            first = jnp.where(no_step, rz, s.first)
            small = ~clips & ~no_step & (rz <= forcing**2 * first)
            # One iteration, unless the residual is small.
            beta = jnp.where(fresh, 0, rz / jnp.where(fresh, 1, s.last))

            def back() -> Table:
                short = self.clip / jnp.maximum(sizes(s.step * apart), self.clip)
                return (short - 1)[:, None] * s.step

            d = jax.lax.cond(clips, back, lambda: beta * s.direction - z)
            hd = jax.lax.cond(small, jnp.zeros_like, product, d)
            damped = hd + s.damping[:, None] * d
            curvature = inner(d, damped)
            more = s.num_rounds < self.max_rounds
            convex = curvature > 0
            concave = ~small & ~clips & ~convex
            alpha = jnp.where(convex & ~small, rz / jnp.where(convex, curvature, 1), 0)
            # (Along a negative curvature: to the bounds.)
            alpha = jnp.where(clips | (concave & ~more), 1, alpha)
            furthest = max_of(sizes((s.step + alpha * d) * apart))
            tried, beyond = alpha, ~small & ~clips & more & (furthest > self.overshoot)
            # (Not further than the limit: where there is hardly any curvature that may be very far.)
            room = (self.overshoot - s.furthest) / jnp.maximum(furthest - s.furthest, tiny)
            alpha *= jnp.where(beyond, jnp.clip(room, 0, 1), 1)
            step, residual = s.step + alpha * d, s.residual + alpha * damped
            # More damping where the step is too long or the curvature negative.
            far = furthest > jnp.where(small, self.overshoot_solved, self.overshoot)
            wants = concave | (~clips & far)
            again = wants & more
            curvature = jnp.where(small | clips, s.curvature, curvature)

            def damp() -> tuple[Table, Float[Array, " rows"]]:
                last = jnp.where(small, s.direction, d)
                rayleigh = curvature / jnp.maximum(inner(last, last), tiny)
                reached = sizes((s.step + tried * d) * apart)
                tighter = jnp.maximum(reached - 1, 0) * (s.damping + rayleigh)
                concavity = -jnp.minimum(row_inner(d, hd), 0)
                negative = 2 * concavity / jnp.maximum(row_inner(d, d), tiny)
                extra = jnp.where(concave, negative, tighter)
                return residual + extra[:, None] * step, s.damping + extra

            residual, damping = jax.lax.cond(again, damp, lambda: (residual, s.damping))
            num_products = s.num_products + jnp.where(small, 0, 1)
            ends = ((small | wants) & ~again) | (num_products >= max_products)
            clip_next = ends & (furthest > self.clip)
            after = jnp.where(ends, jnp.where(clip_next, _CLIP, _END), _SOLVE)
            return _State(
                step,
                residual,
                d,
                jnp.where(again, 0, rz),
                first,
                jnp.where(beyond, self.overshoot, furthest),
                curvature,
                damping,
                factors,
                jnp.where(clips, _END, after),
                num_products,
                s.num_rounds + again,
            )

        zero, number, scalar = jnp.zeros_like(gradient), jnp.array(0), jnp.zeros((), gradient.dtype)
        phase = jnp.where(active & (inner(gradient, gradient) > 0), _SOLVE, _END)
        factors = zeros_of(jax.eval_shape(inverse.factors, damping))
        begin = _State(
            zero,
            gradient,
            zero,
            scalar,
            scalar,
            scalar,
            scalar,
            damping,
            factors,
            phase,
            number,
            number,
        )
        end = jax.lax.while_loop(lambda s: s.phase != _END, iterate, begin)
        hp = end.residual - gradient - end.damping[:, None] * end.step
        return Proposal(end.step, hp, end.damping, end.curvature, end.num_products)
