"""Conjugate gradients for a step within bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vertax._base.reductions import max_of
from vertax.solvers._rows import Table, inner, row_inner, sizes

# The phases of the loop: conjugate gradients, a last pass that clips the step, and the end.
_SOLVE, _CLIP, _END = range(3)


class Proposal(NamedTuple):
    """A step, its product with the Hessian, and the products with the Hessian that it took."""

    step: Table
    product: Table
    num_products: Int[Array, ""]


class _State(NamedTuple):
    step: Table
    residual: Table
    """$g + (H + \\Lambda) p$"""
    preconditioned: Table
    direction: Table
    """The last one."""
    beta: Float[Array, ""]
    damping: Float[Array, " rows"]
    phase: Int[Array, ""]
    num_products: Int[Array, ""]
    num_rounds: Int[Array, ""]


class TruncatedCG(eqx.Module):
    r"""Solves $(H + \Lambda) p = -g$ by conjugate gradients, with bounds for the rows of $p$.

    $\Lambda$ is diagonal, with one number for each row.

    1. Iterate until the preconditioned residual is below `forcing` times the first one.
    2. Where a row is longer than `overshoot` times its bound (`overshoot_solved` once the residual is
        small), or the curvature along a direction is negative, increase $\Lambda$ there and continue from the
        current step; at most `max_rounds` times.
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
        inverse: Callable[[Table, Float[Array, " rows"]], Table],
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
        - `inverse`: the preconditioner, a function of a residual and the damping.
        - `forcing`: the residual at the end, relative to the first one.
        - `max_products`: most products with the Hessian.
        - `active`: whether to do anything; otherwise the step is zero.
        """
        apart = 1 / bounds[:, None]
        tiny = jnp.finfo(gradient.dtype).tiny
        start = inverse(gradient, damping)
        whole = inner(gradient, start)

        def iterate(s: _State) -> _State:
            clips = s.phase == _CLIP
            short = self.clip / jnp.maximum(sizes(s.step * apart), self.clip)
            back = (short - 1)[:, None] * s.step
            d = jnp.where(clips, back, s.beta * s.direction - s.preconditioned)
            hd = product(d)
            damped = hd + s.damping[:, None] * d
            curvature, squared = inner(d, damped), inner(d, d)
            convex = curvature > 0
            safe = jnp.where(convex, curvature, 1)
            alpha = jnp.where(convex, -inner(s.residual, d) / safe, 0)
            alpha = jnp.where(clips, 1, alpha)
            reached = sizes((s.step + alpha * d) * apart)
            furthest = max_of(reached)
            residual = s.residual + alpha * damped
            z = inverse(residual, s.damping)
            small = inner(residual, z) <= forcing**2 * whole
            limit = jnp.where(small, self.overshoot_solved, self.overshoot)
            far = ~clips & convex & (furthest > limit)
            # Beyond the larger limit the step is not taken.
            refused = far & (furthest > self.overshoot)
            alpha = jnp.where(refused, 0, alpha)
            step, residual = s.step + alpha * d, s.residual + alpha * damped
            again = ~clips & (far | ~convex) & (s.num_rounds < self.max_rounds)
            rayleigh = curvature / jnp.maximum(squared, tiny)
            tighter = jnp.maximum(reached - 1, 0) * (s.damping + rayleigh)
            concave = -2 * jnp.minimum(row_inner(d, hd), 0) / jnp.maximum(row_inner(d, d), tiny)
            extra = jnp.where(again, jnp.where(convex, tighter, concave), 0)
            ends = (~again & (small | far | ~convex)) | (s.num_products + 1 >= max_products)
            too_far = (furthest > self.clip) & ~refused
            after = jnp.where(ends, jnp.where(too_far, _CLIP, _END), _SOLVE)
            return _State(
                step,
                residual + extra[:, None] * step,
                jnp.where(refused, s.preconditioned, z),
                d,
                jnp.where(again, 0, inner(z, damped) / safe),
                s.damping + extra,
                jnp.where(clips, _END, after),
                s.num_products + 1,
                s.num_rounds + again,
            )

        zero, none = jnp.zeros_like(gradient), jnp.array(0)
        phase = jnp.where(active & (whole > 0), _SOLVE, _END)
        begin = _State(zero, gradient, start, zero, 0 * whole, damping, phase, none, none)
        end = jax.lax.while_loop(lambda s: s.phase != _END, iterate, begin)
        hp = end.residual - gradient - end.damping[:, None] * end.step
        return Proposal(end.step, hp, end.num_products)
