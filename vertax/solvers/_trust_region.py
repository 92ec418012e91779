"""A trust region for each vertex."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vertax._base.reductions import max_of
from vertax._base.rows import Table, row_inner, sizes


class VertexTrustRegion(eqx.Module):
    r"""How far each vertex may move in the next step.

    The error of a vertex is that of its predicted force,
    $|g_v - (g + H p)_v| / \max(|g_v|, |(H p)_v|)$, at the end of the step. An error that changes the energy
    by less than the average gain per vertex counts as below `small_error`.

    - Accepted: the radius of a vertex grows by `target_error` over its error (2 to `max_growth` times) if
      its error is small or the gain is at least `good_gain` times the predicted one. It shrinks if its error
      is above `large_error`.
    - Rejected: radii of vertices with an error that is not small shrink by `shrink`; the other radii
      halve, unless fewer than the fraction `few` of the vertices shrink.

    All radii start at `max_displacement` of the solver, and return there if all of them have become shorter
    than `collapsed` times that. (Nocedal & Wright 2006, alg. 4.1, doi:10.1007/978-0-387-40065-5, one region
    for each vertex.)
    """

    good_gain: float = 0.75
    small_error: float = 0.25
    large_error: float = 0.75
    target_error: float = 0.1
    max_growth: float = 16.0
    shrink: float = 0.25
    few: float = 0.1
    min_radius: float = 1e-10
    collapsed: float = 1e-9
    shortest: float = 1e-5
    """A radius that steps cut short have made shorter than this, in units of the first one, begins anew."""

    def error(
        self,
        gradient: Table,
        product: Table,
        step: Table,
        after: Table,
        predicted: Float[Array, ""],
    ) -> Float[Array, " rows"]:
        """The error of the predicted force of each row.

        **Arguments:**

        - `gradient`: before the step.
        - `product`: of the step with the Hessian.
        - `step`: the step.
        - `after`: the gradient after the step.
        - `predicted`: the predicted gain.
        """
        missing = after - gradient - product
        scale = jnp.maximum(sizes(gradient), sizes(product))
        error = sizes(missing) / jnp.where(scale > 0, scale, 1)
        harmful = 0.5 * jnp.abs(row_inner(missing, step)) * len(step) > jnp.maximum(predicted, 0)
        return jnp.where(harmful, error, jnp.minimum(error, 0.99 * self.small_error))

    def updated(
        self,
        radii: Float[Array, " rows"],
        step: Table,
        error: Float[Array, " rows"],
        largest: Float[Array, ""] | float,
        accepted: Bool[Array, ""],
        good: Bool[Array, ""],
    ) -> Float[Array, " rows"]:
        """The radii after a step that was accepted, and `good`, or rejected."""
        length = sizes(step)
        length = jnp.where(jnp.isfinite(length), length, jnp.inf)
        predicted = error < self.small_error
        wrong = jnp.dot((~predicted).astype(radii.dtype), jnp.ones_like(radii))
        few = (wrong > 0) & (wrong < self.few * len(radii))
        grows = (good | predicted) & ((length > 0.3 * radii) | (good & (radii < largest)))
        tiny = jnp.finfo(radii.dtype).tiny
        growth = jnp.clip(self.target_error / jnp.maximum(error, tiny), 2, self.max_growth)
        larger = jnp.minimum(growth * radii, largest)
        shrunk = jnp.maximum(self.shrink * radii, jnp.minimum(0.5 * length, radii))
        shrinks = ~good & ~(error <= self.large_error)
        after_success = jnp.where(grows, larger, jnp.where(shrinks, shrunk, radii))
        halved = jnp.where(few, 1, 0.5) * radii
        quarter = self.shrink * jnp.minimum(length, radii)
        radii = jnp.where(accepted, after_success, jnp.where(predicted, halved, quarter))
        return self.restarted(radii, largest)

    def cut(
        self,
        radii: Float[Array, " rows"],
        step: Table,
        fraction: Float[Array, " rows"],
        largest: Float[Array, ""] | float,
    ) -> Float[Array, " rows"]:
        """The radii after a step of which rows could take only a fraction: as after a rejected one."""
        quarter = self.shrink * jnp.minimum(sizes(step), radii)
        quarter = jnp.where(quarter < self.shortest * largest, largest, quarter)
        return self.restarted(jnp.where(fraction < 1, quarter, radii), largest)

    def restarted(
        self, radii: Float[Array, " rows"], largest: Float[Array, ""] | float
    ) -> Float[Array, " rows"]:
        """The radii within their limits; all at the largest one if they have collapsed."""
        radii = jnp.maximum(radii, self.min_radius * largest)
        return jnp.where(max_of(radii) < self.collapsed * largest, largest, radii)
