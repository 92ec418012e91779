"""Cylinders, spherical caps, and graphs of functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from vertax._base.checks import as_real, check_function, check_number
from vertax.surfaces._surface import AbstractSurface, density_of_graph


class Cylinder(AbstractSurface):
    r"""A cylinder, $r = (R \cos(u/R),\; R \sin(u/R),\; v)$.

    The chart is the unrolled cylinder. In a periodic box of width $2 \pi R$ the tissue is a tube. The
    curvature does not change areas; edges are chords, shorter than in the chart by the relative
    $\ell_u^2 / 24 R^2$ for an extent $\ell_u$ around the axis.

    **Arguments:**

    - `radius`: $R$, a length.

    **Raises:**

    - `ValueError` for a radius that is not positive.
    """

    radius: Float[Array, ""]

    def __init__(self, radius: ArrayLike):
        check_number("radius", radius, above=0)
        self.radius = as_real("radius", radius)

    def points(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3"]:
        """Points of the cylinder."""
        angle = x[..., 0] / self.radius
        return jnp.stack(
            [self.radius * jnp.cos(angle), self.radius * jnp.sin(angle), x[..., 1]], axis=-1
        )

    def density(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        """1: the chart has the areas of the cylinder."""
        return jnp.ones_like(x[..., 0])


class SphericalCap(AbstractSurface):
    r"""The upper half of a sphere, $z = \sqrt{R^2 - x^2 - y^2}$.

    The chart is the projection along z; the pole is at the origin. For $x^2 + y^2 > 0.98\,R^2$, where the
    slope is above 7, the sphere is continued by the paraboloid with the same slope, so that a step of a
    solver across the equator has a finite energy.

    **Arguments:**

    - `radius`: $R$, a length.

    **Raises:**

    - `ValueError` for a radius that is not positive, and when a tissue is made with a vertex at
        $x^2 + y^2 > 0.98\,R^2$.
    """

    radius: Float[Array, ""]

    def __init__(self, radius: ArrayLike):
        check_number("radius", radius, above=0)
        self.radius = as_real("radius", radius)

    def points(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3"]:
        """Points of the cap."""
        squared = jnp.sum(x**2, axis=-1, keepdims=True)
        rim = _RIM * self.radius**2
        inside = squared < rim
        height = jnp.sqrt(self.radius**2 - jnp.where(inside, squared, rim))
        beyond = jnp.where(inside, 0, squared - rim) / (2 * height)
        return jnp.concatenate([x, height - beyond], axis=-1)

    def check(self, x: Float[Array, "*shape 2"]) -> None:
        """Raise a `ValueError` for a point too near to the equator."""
        largest = float(jnp.max(jnp.sum(x**2, axis=-1), initial=0.0))
        if largest > _RIM * float(self.radius) ** 2:
            raise ValueError(
                "Argument `surface` must reach below all vertices, but the distance of one from the origin "
                f"is {largest**0.5:.4g}, and a SphericalCap of radius {self.radius:.4g} ends at "
                f"{(_RIM**0.5) * float(self.radius):.4g}. Move the tissue, or choose a larger radius."
            )


_RIM = 0.98
"""Largest $(x^2 + y^2) / R^2$ of the sphere; a paraboloid beyond."""


class Graph(AbstractSurface):
    r"""The graph of a function, $r = (x, y, f(x, y))$.

    ```python
    bump = vx.surfaces.Graph(lambda x: 0.5 * jnp.cos(x[0]) * jnp.cos(x[1]))
    ```

    **Arguments:**

    - `function`: $f$, from a point of shape `(2,)` to its height, a JAX function with two continuous
        derivatives. To differentiate with respect to its parameters, pass an `equinox.Module` with
        `__call__`, or `jax.tree_util.Partial(function, parameters)`.

    **Raises:**

    - `TypeError` if `function` is not callable.
    """

    function: eqx.Module | jax.tree_util.Partial

    def __init__(self, function: Callable[[Float[Array, "2"]], Float[Array, ""]]):
        check_function("function", function, "a function")
        # A plain function is no leaf of the pytree, so that `jax.vmap` and `jax.jit` accept the surface.
        pytree = isinstance(function, eqx.Module | jax.tree_util.Partial)
        self.function = function if pytree else jax.tree_util.Partial(function)

    def points(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3"]:
        """Points of the graph."""
        return jnp.concatenate([x, self._height(x)[..., None]], axis=-1)

    def density(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        """Area in space per area in the chart."""
        return density_of_graph(self._height, x)

    def _height(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        function: Any = self.function
        return jnp.vectorize(function, signature="(n)->()")(x)
