"""The abstract surface: a map from the chart to space."""

from __future__ import annotations

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from vertax._base.announce import announced_jit


class AbstractSurface(eqx.Module):
    r"""A surface in space, $r: \mathbb R^2 \to \mathbb R^3$.

    The vertices of a tissue are coordinates in the chart (the plane). Subclass it, put the parameters into
    fields and write `points`:

    ```python
    class Saddle(vx.surfaces.AbstractSurface):
        height: float

        def points(self, x):
            return jnp.concatenate([x, self.height * x[..., :1] * x[..., 1:]], axis=-1)
    ```

    `points` must have two continuous derivatives (a relaxation uses the second ones), and act on each point
    alone. It must not contain a `jax.custom_vjp`.
    """

    @abc.abstractmethod
    def points(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3"]:
        """Points of space, $r(x)$, in units of length.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """

    def check(self, x: Float[Array, "*shape 2"]) -> None:
        """Raise a `ValueError` for points outside of the chart; by default every point is inside.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart, concrete.
        """

    def jacobian(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3 2"]:
        r"""The tangents $J = \partial r / \partial x$, one column for each coordinate.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """
        return jnp.stack(self.tangents(x), axis=-1)

    def metric(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2 2"]:
        """The metric $g = J^T J$: a step $dx$ in the chart has the squared length $dx^T g dx$ in space.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """
        u, v = self.tangents(x)
        uu, uv, vv = (jnp.sum(a * b, axis=-1) for a, b in ((u, u), (u, v), (v, v)))
        return jnp.stack([jnp.stack([uu, uv], axis=-1), jnp.stack([uv, vv], axis=-1)], axis=-2)

    def density(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        r"""Area in space per area in the chart, $\sqrt{\det g}$.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """
        (a, b, c), (p, q, r) = (jnp.moveaxis(each, -1, 0) for each in self.tangents(x))
        return jnp.sqrt((b * r - c * q) ** 2 + (c * p - a * r) ** 2 + (a * q - b * p) ** 2)

    def tangents(
        self, x: Float[Array, "*shape 2"]
    ) -> tuple[Float[Array, "*shape 3"], Float[Array, "*shape 3"]]:
        """The two columns of `jacobian`.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """
        along = lambda unit: jax.jvp(self.points, (x,), (jnp.broadcast_to(unit, x.shape),))[1]
        u, v = jax.vmap(along)(jnp.eye(2, dtype=x.dtype))
        return u, v

    def sampled(
        self, x: Float[ArrayLike, "*n 2"]
    ) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n"]]:
        """`points` and `density` as NumPy arrays.

        **Arguments:**

        - `x`, shape `(…, 2)`: coordinates in the chart.
        """
        return jax.tree.map(np.asarray, _points_and_density(self, jnp.asarray(x)))

    def tangent_frame(
        self, x: Float[Array, "n 2"]
    ) -> tuple[Float[Array, "n 2 3"], Float[Array, "n 2 2"]]:
        r"""Orthonormal tangents at points, and the Jacobian in this frame.

        **Arguments:**

        - `x`, shape `(n, 2)`: coordinates in the chart.

        **Returns:** the tangents $e$ as rows, shape `(n, 2, 3)`, the first along the first coordinate; and
        the upper triangular $R$ of $J = e^T R$, shape `(n, 2, 2)`.
        """
        u, v = (each.astype(x.dtype) for each in self.tangents(x))
        length = jnp.sqrt(jnp.sum(u**2, axis=-1))
        first = u / length[:, None]
        along = jnp.sum(v * first, axis=-1)
        rest = v - along[:, None] * first
        height = jnp.sqrt(jnp.sum(rest**2, axis=-1))
        frame = jnp.stack([first, rest / height[:, None]], axis=-2)
        upper = [jnp.stack([length, along], axis=-1), jnp.stack([0 * height, height], axis=-1)]
        return frame, jnp.stack(upper, axis=-2)


@announced_jit
def _points_and_density(
    surface: AbstractSurface, x: Float[Array, "*n 2"]
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n"]]:
    return surface.points(x), surface.density(x)


def density_of_graph(
    height: Callable[[Array], Array], x: Float[Array, "*shape 2"]
) -> Float[Array, "*shape"]:
    """The density of the graph of a function of points, from its two slopes."""
    along = lambda unit: jax.jvp(height, (x,), (jnp.broadcast_to(unit, x.shape),))[1]
    p, q = jax.vmap(along)(jnp.eye(2, dtype=x.dtype))
    return jnp.sqrt(1 + p**2 + q**2)
