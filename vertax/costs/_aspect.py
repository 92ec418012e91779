"""The elongation of a whole cluster of cells, or of a box."""

from __future__ import annotations

from functools import partial
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vertax._base.checks import as_real, check_number
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import Free, Periodic, Tissue
from vertax.mesh._arcs import arc_points, length_factor

Measure = Literal["moments", "farthest", "box"]

# Moments are integrals along the outline (Green's theorem). On an arc of angle α the integrand has the
# harmonics up to 4 α of a parameter from -1 to 1: this many Gauss-Legendre points leave only rounding
# errors up to a whole circle, α = π; and a chord, a polynomial, they integrate exactly.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def aspect_ratio(tissue: Tissue, measure: Measure = "moments") -> Float[Array, ""]:
    r"""Ratio of the long to the short axis of a free tissue, $r = L/\ell \ge 1$; or of the sides of a box.

    **Arguments:**

    - `tissue`: a free tissue; or a periodic one, of which the box is measured.
    - `measure`: `"moments"` is $\sqrt{\lambda_1/\lambda_2}$ with the eigenvalues of the matrix of second
        moments of the area within the outline (its arcs included), the axis ratio of the ellipse of
        the same moments. Every part of the outline counts and it is smooth, but at $r = 1$, where it
        has a kink (no axis is the long one) and a derivative of 0 here. `"farthest"` is the paper's:
        $L$ is the distance of the two vertices farthest apart, and $\ell$ the width of all vertices
        across the line through them. Its derivative sees four vertices and jumps when others become
        the outermost. `"box"` is how many times longer the first lattice vector of a periodic tissue is than
        the second, for a box that comes to rest ([`BoxRelaxation`][vertax.mechanics.BoxRelaxation]).

    **Returns:** the ratio.

    **Raises:**

    - `ValueError` for a periodic tissue, a free one if it is to be `"box"`, or another measure.
    """
    _check_measure(measure)
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
            "The aspect ratio is that of an outline, which only a free tissue has, but the boundary is "
            f'{type(boundary).__name__}: pass measure="box" for that of its box.'
        )
    return _from_moments(tissue) if measure == "moments" else _from_farthest(tissue)


class AspectRatio(AbstractLeastSquaresCost):
    r"""Squared distance of the aspect ratio of a tissue from a target (paper, "Convergent extension").

    $$C = \left(\frac{L}{\ell} - r_\mathrm{target}\right)^2$$

    **Arguments:**

    - `target`: the ratio to reach, at least 1; of a box also below.
    - `measure`: how the ratio is measured, see [`aspect_ratio`][vertax.costs.aspect_ratio].

    **Raises:**

    - `ValueError` for a target below 1 (of a box, not above 0), a tissue that does not go with the
        measure, or another measure.
    """

    target: Float[Array, ""] = eqx.field(converter=partial(as_real, "target"))
    measure: Measure = eqx.field(static=True, default="moments")

    def __check_init__(self):
        _check_measure(self.measure)
        limit = {"above": 0} if self.measure == "box" else {"least": 1}
        check_number("target", self.target, **limit, many=True)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """The distance, times the root of 2: the paper's cost is the square, not half of it."""
        check_number("target", self.target)
        return jnp.sqrt(2.0) * (aspect_ratio(tissue, self.measure) - self.target)[None]


def _check_measure(measure: str) -> None:
    if measure not in get_args(Measure):
        raise ValueError(
            f"Argument `measure` must be one of {get_args(Measure)}, but is {measure!r}."
        )


def _from_moments(tissue: Tissue) -> Float[Array, ""]:
    xx, xy, yy = _second_moments(tissue)
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    # The eigenvalues are mean ± spread. The `where` is doubled: the slope of a root at 0 is infinite.
    squared = half**2 + xy**2
    distinct = squared > 0
    spread = jnp.where(distinct, jnp.sqrt(jnp.where(distinct, squared, 1)), 0)
    # Their product is the determinant: mean - spread cancels for a long tissue.
    return (mean + spread) / jnp.sqrt(xx * yy - xy**2)


def _second_moments(tissue: Tissue) -> tuple[Array, Array, Array]:
    r"""$\int x^2, \int xy, \int y^2$ over the area within the outline, about its centroid."""
    first, chord = tissue.edge_segments
    angle = tissue.edge_angles
    # Far from the origin the integrals would lose digits.
    first = first - jnp.mean(tissue.vertices, axis=0)
    nodes, weights = (jnp.asarray(x, chord.dtype) for x in (_NODES, _WEIGHTS / 2))
    points = arc_points(first, chord, angle, (1 + nodes) / 2)
    # On its way from the start to the end the tangent turns by 2 α, and is along the chord half-way.
    turn = angle[:, None] * nodes
    cos, sin = jnp.cos(turn)[..., None], jnp.sin(turn)[..., None]
    left = jnp.stack([-chord[:, 1], chord[:, 0]], axis=-1)
    velocity = length_factor(angle)[:, None, None] * (cos * chord[:, None] + sin * left[:, None])
    # For a function f that is homogeneous of degree n, ∫ f dA = 1/(n + 2) ∮ f p × dp; on the outline the
    # tissue is on the left of each edge. Edges inside do not count.
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
