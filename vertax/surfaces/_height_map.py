"""Surfaces from images of heights."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.ndimage import gaussian_filter1d, spline_filter1d
from scipy.sparse import csc_array, csr_array, eye_array, kron
from scipy.sparse.linalg import splu

from vertax._base.checks import as_float64, check_number
from vertax._base.pixels import PixelSizeLike, check_pixel_size, pixel_sides
from vertax._base.sums import total
from vertax._base.tracing import is_concrete
from vertax.surfaces._surface import AbstractSurface, density_of_graph

# The height is a uniform cubic B-spline with the coefficients c at the centres of pixels. Along one axis,
#
#     z(s) = Σ_k c_k β(s - k),    β = ((1-t)³, 3t³ - 6t² + 4, -3t³ + 3t² + 3t + 1, t³) / 6,    t = s - ⌊s⌋,
#
# and c = S h interpolates the heights h at the pixels. All steps (extension beyond the rim, Gaussian, S) are
# linear and separable: c = A_y h A_xᵀ with a matrix for each axis, so c is differentiable in h.
#
# The picture is extended oddly about its outermost pixels, h(-k) = 2 h(0) - h(k): a tilted plane stays one.
# The second derivative at the rim is then 0, so the linear continuation outside has two derivatives too.


class HeightMap(AbstractSurface):
    r"""A surface from an image of heights, $r = (x, y, z(x, y))$.

    The heights are multiplied by `plane_distance`, unknown pixels are filled, the result is smoothed by a
    Gaussian of standard deviation `smoothing`, and interpolated by a bicubic B-spline, which has two
    continuous derivatives. The centre of the pixel in row r and column c is at
    $(c + \tfrac12, r + \tfrac12)$ times the size of a pixel, as in all images of vertax. Outside of the
    picture the surface continues linearly.

    An unknown pixel gets the mean of the known ones with Gaussian weights (normalised convolution); the width
    of the weights is `smoothing`, but at least one pixel, and is doubled until all pixels are filled. The
    smoothing reduces a wave of length $\lambda$ by the factor $e^{-2 \pi^2 \sigma^2 / \lambda^2}$.

    A height map has one height at each point: overhangs and closed surfaces are out of its reach.

    **Arguments:**

    - `heights`, shape `(rows, columns)`: numbers of planes, or lengths. Differentiable.
    - `pixel_size`: side of a pixel in the tissue's units of length, or (height, width).
    - `plane_distance`: height per unit of `heights`, in the tissue's units of length.
    - `smoothing`: standard deviation $\sigma$ of the Gaussian, a length. 0 interpolates the heights. Integer
        heights are steps of planes, which have no slope: they need at least one pixel.
    - `unknown`: value of unknown pixels, such as 0. NaN is unknown if `unknown` is NaN or a number.
    - `periodic`: whether the picture is one period of the surface: the periodic box of the tissue has the
        size of the picture.
    - `origin`: position of the corner of the first pixel.

    **Raises:**

    - `TypeError` for heights that are not real numbers.
    - `ValueError` for heights that are not a matrix of at least 4 × 4, NaN or infinity without `unknown`, no
        known pixel, integer heights with a smoothing of less than a pixel, traced heights with `unknown`
        (which pixels are known must be concrete), or numbers out of range.
    """

    coefficients: Float[Array, "rows columns"]
    """Coefficients of the B-spline, heights in units of length. One more row and column at each side, unless
    the surface is periodic."""
    sides: Float[Array, "2"]
    """Width and height of a pixel."""
    origin: Float[Array, "2"]
    """Position of the corner of the first pixel."""
    periodic: bool = eqx.field(static=True)

    def __init__(
        self,
        heights: ArrayLike,
        pixel_size: PixelSizeLike,
        *,
        plane_distance: float | Float[Array, ""] = 1.0,
        smoothing: float = 0.0,
        unknown: float | None = None,
        periodic: bool = False,
        origin: tuple[float, float] | Float[ArrayLike, "2"] = (0.0, 0.0),
    ):
        check_pixel_size("pixel_size", pixel_size)
        check_number("plane_distance", plane_distance, above=0)
        check_number("smoothing", smoothing, at_least=0)
        sides = pixel_sides(pixel_size)
        xp = np if is_concrete(heights) else jnp
        given = xp.asarray(heights)
        widths = float(smoothing) / sides[::-1]
        _check_heights(given, widths, unknown)
        values = given if xp is jnp else given.astype(np.result_type(given, np.float32))
        if unknown is not None:
            values = _filled(np.asarray(values), widths, unknown)
        down, across = (
            _operator(n, width, periodic) for n, width in zip(values.shape, widths, strict=True)
        )
        dtype = jnp.result_type(values, jnp.float32)
        product = jnp.linalg.multi_dot([down, values, across.T], precision="highest")
        self.coefficients = product.astype(dtype) * plane_distance
        self.sides = jnp.asarray(sides, dtype)
        self.origin = jnp.asarray(origin, dtype)
        self.periodic = periodic

    @classmethod
    def through(cls, points: ArrayLike) -> HeightMap:
        r"""The smooth height map through given points, such as the vertices of a table.

        Its grid has four pixels for each point. The coefficients $c$ of the B-spline minimise the sum of
        squares of the residuals plus $10^{-4} \sum |\nabla^3 c|^2$ (third differences, in pixels), which
        determines the heights between the points: quadratic surfaces are reproduced.

        **Arguments:**

        - `points`, shape `(points, 3)`: x, y and z, in units of length.

        **Raises:**

        - `ValueError` for points of another shape, not finite, fewer than three or on a line in the
            projection along z, and for overhangs: points that are no function of x and y.
        """
        given = as_float64("points", points)
        if given.ndim != 2 or given.shape[1] != 3 or not np.isfinite(given).all():
            raise ValueError(
                "Argument `points` must hold finite x, y and z of each point, shape (points, 3), but has the "
                f"shape {given.shape}{', and NaN or infinity' if given.shape[-1:] == (3,) else ''}."
            )
        place = given[:, :2]
        plane = np.column_stack([place, np.ones(len(place))])
        tilt, _, rank, _ = np.linalg.lstsq(plane, given[:, 2])
        if rank < 3:
            raise ValueError(
                "Argument `points` must have three points that are not on a line in the projection along z, "
                f"but its {len(given)} points have none."
            )
        extent = np.ptp(place, axis=0)
        side = float(np.sqrt(np.prod(extent) / (4 * len(place))))
        origin = place.min(axis=0) - side
        width, height = np.maximum(np.ceil(extent / side).astype(int) + 2, 4).tolist()
        position = (place - origin) / side - 0.5
        rest = given[:, 2] - plane @ tilt
        coefficients, residuals = _spline_through(position, rest, (height + 2, width + 2))
        worst = int(np.argmax(np.abs(residuals)))
        if np.abs(residuals[worst]) > side:
            raise ValueError(
                "Argument `points` must have one height at each x and y, but the smooth surface is "
                f"{np.abs(residuals[worst]):.3g} away from point {worst}, {given[worst].round(6).tolist()}. "
                "Overhangs are out of reach of a height map: turn the tissue, or cut it."
            )
        x, y = (
            o + side * (np.arange(n + 2) - 0.5)
            for o, n in zip(origin, (width, height), strict=True)
        )
        coefficients += tilt[0] * x + tilt[1] * y[:, None] + tilt[2]
        flat = cls(np.zeros((height, width)), side, origin=origin)
        return eqx.tree_at(lambda s: s.coefficients, flat, jnp.asarray(coefficients))

    def points(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape 3"]:
        """Points of the surface."""
        return jnp.concatenate([x, self._height(x)[..., None]], axis=-1)

    def density(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        """Area in space per area in the chart."""
        return density_of_graph(self._height, x)

    def _height(self, x: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        position = (x - self.origin) / self.sides - 0.5
        return _spline((0, 0), self.periodic, self.coefficients, position[..., 0], position[..., 1])


def _spline_through(
    position: Float[np.ndarray, "points 2"], z: Float[np.ndarray, " points"], shape: tuple[int, int]
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, " points"]]:
    """Coefficients of the B-spline through heights at positions in pixels, and the residuals."""
    first = np.floor(position).astype(int)
    weights = np.stack([part(position - first) for part in _BASIS], axis=-1)
    columns, rows = (first[:, axis, None] + np.arange(4) for axis in (0, 1))
    index = rows[:, :, None] * shape[1] + columns[:, None, :]
    values, size = weights[:, 1, :, None] * weights[:, 0, None, :], shape[0] * shape[1]
    row = np.repeat(np.arange(len(z)), 16)
    spline = csr_array((values.ravel(), (row, index.ravel())), shape=(len(z), size))
    normal = spline.T @ spline + _RIDGE * eye_array(size)
    for order, count in enumerate((1, 3, 3, 1)):
        bend = kron(_difference(shape[0], order), _difference(shape[1], 3 - order))
        normal = normal + _BENDING * count * bend.T @ bend
    coefficients = splu(csc_array(normal)).solve(spline.T @ z)
    return coefficients.reshape(shape), spline @ coefficients - z


_BENDING, _RIDGE = 1e-4, 1e-12
"""Weights of the squares of third differences, and of all coefficients (for what points do not determine)."""


def _difference(n: int, order: int) -> Any:
    """The matrix of differences of some order of n values."""
    matrix: Any = eye_array(n, format="csr")
    for _ in range(order):
        matrix = matrix[1:] - matrix[:-1]
    return matrix


# A derivative of the spline is another contraction of the same coefficients. (Without the rule each
# Hessian-vector product would read all intermediate products of the contraction.)
@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _spline(
    orders: tuple[int, int], periodic: bool, coefficients: Array, column: Array, row: Array
) -> Array:
    """A derivative of the spline, of given orders along columns and rows, at positions in pixels."""
    n_rows, n_columns = coefficients.shape
    columns, to_columns = _stencil(column, n_columns, periodic, orders[0])
    rows, to_rows = _stencil(row, n_rows, periodic, orders[1])
    # (Unrolled: one loop over the points, instead of sums along short axes.)
    place = jnp.stack([i * n_columns + j for i in rows for j in columns])
    near = coefficients.ravel().at[place].get(mode="promise_in_bounds")
    sums = [total(near[4 * i + j] * to_columns[j] for j in range(4)) for i in range(4)]
    return total(values * weight for values, weight in zip(sums, to_rows, strict=True))


@_spline.defjvp
def _(orders: tuple[int, int], periodic: bool, primals: tuple, tangents: tuple) -> tuple:
    _, column, row = primals
    across, down = (orders[0] + 1, orders[1]), (orders[0], orders[1] + 1)
    change = _spline(across, periodic, *primals) * tangents[1]
    change += _spline(down, periodic, *primals) * tangents[2]
    change += _spline(orders, periodic, tangents[0], column, row)
    return _spline(orders, periodic, *primals), change


def _check_heights(heights: Array | np.ndarray, widths: np.ndarray, unknown: float | None) -> None:
    if heights.dtype.kind not in "fiu":
        raise TypeError(
            f"Argument `heights` must hold real numbers, but its type is {heights.dtype}."
        )
    if heights.ndim != 2 or min(heights.shape) < 4:
        raise ValueError(
            "Argument `heights` must be a matrix of at least 4 x 4 pixels, but its shape is "
            f"{heights.shape}."
        )
    if widths.min() < 1 and _are_planes(heights):
        raise ValueError(
            "Argument `smoothing` must be at least one pixel for integer heights, which are steps of planes "
            "without a slope. Pass e.g. half the size of a cell."
        )
    if not is_concrete(heights):
        if unknown is not None:
            raise ValueError(
                "Argument `unknown` must be None for traced heights: fill the unknown pixels outside of "
                "jax.jit and jax.grad."
            )
        return
    bad = ~np.isfinite(heights)
    if unknown is not None:
        bad &= ~np.isnan(heights)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"Argument `heights` must be finite, but {bad.sum()} of its {bad.size} pixels are not, e.g. that "
            f"in row {row} and column {column}. Pass `unknown=numpy.nan` to fill NaN from the pixels around."
        )


def _are_planes(heights: Array | np.ndarray) -> bool:
    """Whether heights are integers; those in floating-point numbers too, unless all are equal or traced."""
    if heights.dtype.kind in "iu" or not is_concrete(heights):
        return heights.dtype.kind in "iu"
    finite = np.asarray(heights)[np.isfinite(heights)]
    return finite.size > 0 and bool(np.all(finite == np.rint(finite)) and np.ptp(finite) > 0)


def _filled(heights: np.ndarray, widths: np.ndarray, unknown: float) -> np.ndarray:
    """The heights, with unknown pixels filled by normalised convolution."""
    valid = ~(np.isnan(heights) | (heights == unknown))
    if not valid.any():
        raise ValueError(
            f"Argument `heights` must have valid pixels, but all are {unknown} or NaN."
        )
    filled, weight = np.where(valid, heights, 0).astype(float), valid.astype(float)
    todo, widths = ~valid, np.maximum(widths, 1)
    while todo.any():
        blur = lambda image, widths=widths: gaussian_filter1d(
            gaussian_filter1d(image, widths[0], axis=0, mode="constant"),
            widths[1],
            axis=1,
            mode="constant",
        )
        total = blur(weight)
        near = todo & (total > _LEAST_WEIGHT)
        filled[near] = blur(np.where(valid, heights, 0).astype(float))[near] / total[near]
        todo, widths = todo & ~near, 2 * widths
    return filled


_LEAST_WEIGHT = 0.01
"""Least sum of the weights of known pixels from which a pixel is filled."""
_MARGIN = 24
"""Pixels by which a picture is extended for the filter of the B-spline, which decays by 0.27 per pixel."""


def _operator(n: int, width: float, periodic: bool) -> np.ndarray:
    """The matrix from heights along one axis to coefficients of the smoothed B-spline."""
    margin = 0 if periodic else int(np.ceil(4 * width)) + _MARGIN
    rows = np.eye(n)
    if margin:
        rows = np.pad(rows, ((margin, margin), (0, 0)), mode="reflect", reflect_type="odd")
    if width > 0:
        rows = gaussian_filter1d(rows, width, axis=0, mode="wrap" if periodic else "nearest")
    if periodic:
        return spline_filter1d(rows, axis=0, mode="grid-wrap")
    inner = rows[margin : len(rows) - margin]
    extended = np.pad(inner, ((_MARGIN, _MARGIN), (0, 0)), mode="reflect", reflect_type="odd")
    return spline_filter1d(extended, axis=0, mode="mirror")[_MARGIN - 1 : n + _MARGIN + 1]


def _stencil(
    position: Float[Array, "*shape"], size: int, periodic: bool, order: int
) -> tuple[list[Array], list[Array]]:
    """Indices of the four coefficients along one axis, and their weights in a derivative of some order."""
    first = jnp.floor(position)
    if not periodic:  # the coefficients begin one pixel before the first one
        first = jnp.clip(first, 0, size - 4)
    t = position - first
    inside = jnp.clip(t, 0, 1)
    weights = [jnp.polyval(each.deriv(order).coeffs, inside) for each in _BASIS]
    if not periodic:
        slopes = [jnp.polyval(each.deriv(order + 1).coeffs, inside) for each in _BASIS]
        if order == 0:
            weights = [w + (t - inside) * v for w, v in zip(weights, slopes, strict=True)]
        if order > 1:
            weights = [jnp.where(t == inside, weight, 0) for weight in weights]
    start = first.astype(jnp.int32) - (1 if periodic else 0)
    indices = [start + k for k in range(4)]
    return [index % size for index in indices] if periodic else indices, weights


_BASIS = [
    np.poly1d(np.array(powers) / 6)
    for powers in ([-1, 3, -3, 1], [3, -6, 0, 4], [-3, 3, 3, 1], [1, 0, 0, 0])
]
"""The four parts of the cubic B-spline, polynomials in t."""
