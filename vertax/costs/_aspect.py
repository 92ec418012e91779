"""Aspect ratio of a free tissue or of a periodic box."""

from __future__ import annotations

from functools import partial
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vertax._base.arcs import arc_points, length_factor
from vertax._base.checks import as_real, check_choice, check_number
from vertax._base.model_checks import check_planar
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Free, Periodic, Tissue

Measure = Literal["moments", "farthest", "box"]

# Moments are integrals along the outline (Green's theorem). On an arc of half-angle α the integrand contains
# cos(4 α s) with s in [-1, 1]: 24 Gauss-Legendre points are exact to rounding up to a full circle, α = π. On
# a straight edge the integrand is a polynomial, which they integrate exactly.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def aspect_ratio(tissue: Tissue, measure: Measure = "moments") -> Float[Array, ""]:
    r"""Ratio of the long to the short axis of a free tissue, $r = L/\ell \ge 1$, or of the sides of a box.

    | `measure` | ratio |
    |---|---|
    | `"moments"` | $\sqrt{\lambda_1/\lambda_2}$, eigenvalues of the second-moment matrix of the area |
    | `"farthest"` | largest distance of two vertices over the width of the tissue across it (the paper's) |
    | `"box"` | length of the first lattice vector over that of the second |

    `"moments"` includes arcs and depends smoothly on the whole outline, except at $r = 1$, where the
    derivative is undefined and 0 is returned. The derivative of `"farthest"` depends on four vertices and is
    discontinuous where the extreme vertices change. `"box"` is meant for periodic tissues with a box that
    relaxes too ([`BoxRelaxation`][vertax.mechanics.BoxRelaxation]).

    **Arguments:**

    - `tissue`: a free tissue; a periodic one for `"box"`.
    - `measure`: `"moments"`, `"farthest"` or `"box"`, see above.

    **Returns:** the ratio.

    **Raises:**

    - `ValueError` for an unknown measure, one that does not apply to the boundary of the tissue, or a tissue
        on a surface.
    """
    _check_measure(measure)
    check_planar("its aspect ratio", tissue)
    boundary = tissue.boundary
    if isinstance(boundary, Periodic) and measure == "box":
        first, second = jnp.linalg.norm(boundary.lattice, axis=1)
        return first / second
    if measure == "box":
        raise ValueError(
            'Argument `measure` can be "box" only for a periodic tissue, but the boundary is '
            f"{type(boundary).__name__}."
        )
    if not isinstance(boundary, Free):
        raise ValueError(
            f'Argument `measure` can be "{measure}" only for a free tissue, but the boundary is '
            f'{type(boundary).__name__}. For the aspect ratio of a periodic box pass measure="box".'
        )
    return _from_moments(tissue) if measure == "moments" else _from_farthest(tissue)


class AspectRatio(AbstractLeastSquaresCost):
    r"""Squared difference of the aspect ratio of a tissue and a target (paper, "Convergent extension").

    $$C = \left(\frac{L}{\ell} - r_\mathrm{target}\right)^2$$

    **Arguments:**

    - `target`: the target ratio, at least 1 (for `"box"`, above 0).
    - `measure`: the definition of the ratio, see [`aspect_ratio`][vertax.costs.aspect_ratio].

    **Raises:**

    - `ValueError` for a target out of range, an unknown measure, or a measure that does not apply to the
        boundary of the tissue.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    measure: Measure = eqx.field(static=True, default="moments")

    def __check_init__(self):
        _check_measure(self.measure)
        above, at_least = (0, None) if self.measure == "box" else (None, 1)
        check_number("target", self.target, above=above, at_least=at_least, many=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        r"""$\sqrt2\,(r - r_\mathrm{target})$, because the cost is half the sum of squares."""
        check_number("target", self.target)
        return jnp.sqrt(2.0) * (aspect_ratio(tissue, self.measure) - self.target)[None]


def _check_measure(measure: str) -> None:
    check_choice("measure", measure, get_args(Measure))


def _from_moments(tissue: Tissue) -> Float[Array, ""]:
    xx, xy, yy = _second_moments(tissue)
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    # The eigenvalues are mean ± spread. The inner `where` keeps the derivative of the root finite at 0.
    squared = half**2 + xy**2
    distinct = squared > 0
    spread = jnp.where(distinct, jnp.sqrt(jnp.where(distinct, squared, 1)), 0)
    # √(λ₁/λ₂) = λ₁/√(λ₁ λ₂) with the determinant λ₁ λ₂, because λ₂ = mean - spread suffers from cancellation.
    return (mean + spread) / jnp.sqrt(xx * yy - xy**2)


def _second_moments(tissue: Tissue) -> tuple[Array, Array, Array]:
    r"""$\int x^2, \int xy, \int y^2$ over the area within the outline, about its centroid."""
    first, chord = tissue.edge_segments
    angle = tissue.edge_angles
    # Shift the origin to the tissue, to avoid cancellation.
    first = first - jnp.mean(tissue.vertices, axis=0)
    nodes, weights = (jnp.asarray(x, chord.dtype) for x in (_NODES, _WEIGHTS / 2))
    points = arc_points(first, chord, angle, (1 + nodes) / 2)
    # Along an arc the tangent turns by 2 α; at the middle it is parallel to the chord.
    tangent_angle = angle[:, None] * nodes
    cos, sin = jnp.cos(tangent_angle)[..., None], jnp.sin(tangent_angle)[..., None]
    normal = jnp.stack([-chord[:, 1], chord[:, 0]], axis=-1)
    velocity = length_factor(angle)[:, None, None] * (cos * chord[:, None] + sin * normal[:, None])
    # For f homogeneous of degree n, ∫ f dA = 1/(n + 2) ∮ f p × dp, counter-clockwise along the outline: the
    # tissue is on the left of each outline edge. Inner edges do not contribute.
    swept = points[..., 0] * velocity[..., 1] - points[..., 1] * velocity[..., 0]
    swept = jnp.where(tissue.topology.on_outline[:, None], weights * swept, 0)
    area = jnp.sum(swept) / 2
    centre = jnp.sum(points * swept[..., None], axis=(0, 1)) / (3 * area)
    x, y = points[..., 0], points[..., 1]
    moment = lambda f, a, b: jnp.sum(f * swept) / 4 - area * a * b
    return (
        moment(x * x, centre[0], centre[0]),
        moment(x * y, centre[0], centre[1]),
        moment(y * y, centre[1], centre[1]),
    )


def _from_farthest(tissue: Tissue) -> Float[Array, ""]:
    vertices = tissue.gathered(tissue.vertices)
    between = vertices[:, None] - vertices[None]
    flat = jnp.argmax(jnp.sum(between**2, axis=-1))
    axis = between.reshape(-1, 2)[flat]
    length = jnp.sqrt(jnp.sum(axis**2))
    across = (vertices[:, 0] * axis[1] - vertices[:, 1] * axis[0]) / length
    return length / (jnp.max(across) - jnp.min(across))
