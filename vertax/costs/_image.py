"""A tissue as a fluorescence image, and its distance to a measured one."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from vertax._base.checks import as_float64, as_real, check_integer, check_number, check_shape
from vertax._base.model_checks import check_single
from vertax._base.plane import inverse_of
from vertax._base.tracing import is_concrete
from vertax.costs._cost import AbstractLeastSquaresCost
from vertax.energies import AbstractEnergy
from vertax.mesh import AbstractBoundary, Free, Periodic, Tissue


# Non-uniform FFT of the edges, a line density on the plane, times a Gaussian transfer function:
# 1. represent each edge by Gauss-Legendre points, weighted by length;
# 2. spread each point on the pixels by a quintic B-spline (6 × 6 pixels, four times differentiable);
# 3. take the FFT; divide by the transform of the spline and multiply by that of the Gaussian;
# 4. take the inverse FFT.
# Cost: edges × points × 36 + pixels log(pixels). The direct sum of the transforms of all segments, as in the
# paper, costs edges × pixels.
def render(
    tissue: Tissue,
    shape: tuple[int, int],
    psf_width: float | Float[Array, ""],
    *,
    points_per_edge: int = 32,
    pixel_size: float | Float[Array, ""] | None = None,
) -> Float[Array, "rows columns"]:
    r"""Fluorescence image of the edges of a tissue (paper, Methods, "Mesh-Image cost").

    The line density of the edges (straight or arcs), convolved with a Gaussian of standard deviation
    `psf_width`. The image of a periodic tissue covers one period: pixel `[r, c]` is centred at the
    fraction $(c + \tfrac12)/columns$ of the first lattice vector and $(r + \tfrac12)/rows$ of the second,
    so rows follow $y$. The image of a free tissue has a corner at the origin: pixel `[r, c]` is centred at
    $x = c + \tfrac12$, $y = r + \tfrac12$ times `pixel_size`.

    **Arguments:**

    - `tissue`: a tissue with a [`Periodic`][vertax.Periodic] or a [`Free`][vertax.Free] boundary.
    - `shape`: rows and columns, at least 6 each.
    - `psf_width`: standard deviation of the point spread function, in units of length. The relative error is
        a few 1e-3 for one pixel, and about 1e-6 for two pixels or more.
    - `points_per_edge`: quadrature points $n$ on each edge. The relative error is about 1e-5 for edges up to
        $0.7\,n$ times `psf_width`.
    - `pixel_size`: length of a pixel side; required for a free tissue, not allowed for a periodic one.

    **Returns:** line density (length of edge per area) at the pixel centres.

    **Raises:**

    - `TypeError` for a boundary that is neither periodic nor free.
    - `ValueError` for an image below 6 × 6 pixels, a width, number of points or pixel size that is not
        positive, a batch, and a missing or superfluous `pixel_size`.
    """
    if len(np.shape(shape)) != 1 or len(shape) != 2:
        raise ValueError(f"Argument `shape` must be (rows, columns), but is {shape}.")
    for side in shape:
        check_integer("shape", side)
    if min(shape) < _SPLINE_POINTS:
        raise ValueError(f"Argument `shape` must be at least 6 × 6 pixels, but is {shape}.")
    check_number("psf_width", psf_width, above=0)
    check_integer("points_per_edge", points_per_edge, at_least=1)
    if pixel_size is not None:
        check_number("pixel_size", pixel_size, above=0)
    check_single(tissue)
    lattice, (rows, columns) = _canvas(tissue.boundary, shape, pixel_size)
    dtype = tissue.vertices.dtype
    nodes, weights = np.polynomial.legendre.leggauss(points_per_edge)
    nodes, weights = jnp.asarray(nodes / 2 + 0.5, dtype), jnp.asarray(weights / 2, dtype)

    points = tissue.edge_points(nodes)
    mass = (tissue.edge_lengths[:, None] * weights).reshape(-1)
    # Rows of `inverse` are the reciprocal vectors: fraction = inverse @ position.
    inverse = inverse_of(lattice).T
    fractions = points.reshape(-1, 2) @ inverse.T
    if isinstance(tissue.boundary, Free):
        # Drop points further from the image than half its size: the FFT would wrap them into it.
        mass = jnp.where(jnp.all(jnp.abs(fractions - 0.25) < 0.5, axis=-1), mass, 0)
    column, wx = _spread(fractions[:, 0] * columns - 0.5, columns)
    row, wy = _spread(fractions[:, 1] * rows - 0.5, rows)
    index = row[:, :, None] * columns + column[:, None, :]
    values = mass[:, None, None] * wy[:, :, None] * wx[:, None, :]
    grid = jnp.zeros(rows * columns, dtype).at[index].add(values).reshape(rows, columns)

    ky = jnp.asarray(np.fft.fftfreq(rows, 1 / rows), dtype)[:, None]
    kx = jnp.asarray(np.fft.rfftfreq(columns, 1 / columns), dtype)[None, :]
    xi = 2 * jnp.pi * (kx[..., None] * inverse[0] + ky[..., None] * inverse[1])
    spline = (jnp.sinc(kx / columns) * jnp.sinc(ky / rows)) ** _SPLINE_POINTS
    transfer = jnp.exp(-0.5 * psf_width**2 * jnp.sum(xi**2, axis=-1)) / spline
    pixel_area = jnp.linalg.det(lattice) / (rows * columns)
    image = jnp.fft.irfft2(jnp.fft.rfft2(grid) * transfer, s=(rows, columns)) / pixel_area
    return image[: shape[0], : shape[1]]


def _canvas(
    boundary: AbstractBoundary, shape: tuple[int, int], pixel_size: float | Array | None
) -> tuple[Float[Array, "2 2"], tuple[int, int]]:
    """The periodic lattice and pixel numbers of the FFT; the image is its first rows and columns."""
    if isinstance(boundary, Periodic) and pixel_size is None:
        return boundary.lattice, shape
    if isinstance(boundary, Free) and pixel_size is not None:
        # Twice as wide and high, so that nothing wraps around into the image.
        rows, columns = 2 * shape[0], 2 * shape[1]
        return jnp.diag(jnp.array([columns, rows]) * pixel_size), (rows, columns)
    if isinstance(boundary, Periodic | Free):
        raise ValueError(
            "Argument `pixel_size` must be given for a free tissue, and None for a periodic one, but is "
            f"{pixel_size} for a boundary of class {type(boundary).__name__}."
        )
    raise TypeError(
        "Argument `tissue` must have a Periodic or Free boundary, but it is "
        f"{type(boundary).__name__}."
    )


_SPLINE_POINTS = 6


def _spread(
    position: Float[Array, " points"], size: int
) -> tuple[Int[Array, "points 6"], Float[Array, "points 6"]]:
    """Pixels (wrapped around) and quintic B-spline weights of points, in units of pixels."""
    pixel_below = jax.lax.stop_gradient(jnp.floor(position))
    u = position - pixel_below
    # Cox-de Boor recursion: w[k] at degree d is the weight of the k-th of d + 1 neighbouring pixels.
    w = [jnp.ones_like(u)]
    for d in range(1, _SPLINE_POINTS):
        zero = jnp.zeros_like(u)
        lower, upper = [zero, *w], [*w, zero]
        w = [((u + d - k) * lower[k] + (k + 1 - u) * upper[k]) / d for k in range(d + 1)]
    first = pixel_below.astype(jnp.int32) - (_SPLINE_POINTS // 2 - 1)
    pixels = first[:, None] + jnp.arange(_SPLINE_POINTS, dtype=jnp.int32)
    return jnp.mod(pixels, size), jnp.stack(w, axis=-1)


class MeshImage(AbstractLeastSquaresCost):
    r"""Squared difference between the image of a tissue and a measured image (paper, Methods).

    $$C = \frac{1}{2M} \sum_{k=1}^{M} \bigl(a\,I(X)(r_k) + b - I_{\mathrm{exp}}(r_k)\bigr)^2$$

    over the $M$ pixels, with the rendered image $I(X)$ (see [`render`][vertax.costs.render]). The measured
    image is standardised to mean 0 and variance 1. The intensity scale $a \ge 0$ and background $b$ minimise
    $C$ in closed form, so the cost is independent of brightness and contrast:
    $C = \tfrac12(1 - \max(\rho, 0)^2)$ with the correlation $\rho$ of the two images.

    **Arguments:**

    - `image`: the measured image, rows along y, of one period of the tissue or of a free tissue. See
        [`mirror`][vertax.costs.mirror] for images that are not periodic.
    - `psf_width`: standard deviation of the point spread function, in units of length.
    - `weight`: weight of each pixel, at least 0; by default equal.
    - `points_per_edge`: quadrature points on each edge, see [`render`][vertax.costs.render].
    - `fit_intensity`: False sets $a = 1$, $b = 0$, and does not standardise the image.
    - `pixel_size`: length of a pixel side; required for a free tissue, not allowed for a periodic one.

    **Raises:**

    - `ValueError` for an image that is not two-dimensional, not finite or constant, a weight of the wrong
        shape, or a width that is not positive.
    """

    image: Float[Array, "rows columns"]
    psf_width: Float[Array, ""]
    weight: Float[Array, "rows columns"]
    points_per_edge: int = eqx.field(static=True)
    fit_intensity: bool = eqx.field(static=True)
    pixel_size: Float[Array, ""] | None

    def __init__(
        self,
        image: ArrayLike,
        psf_width: float | Float[Array, ""],
        *,
        weight: ArrayLike | None = None,
        points_per_edge: int = 32,
        fit_intensity: bool = True,
        pixel_size: float | Float[Array, ""] | None = None,
    ):
        # Inside jax.vmap the image is traced: it cannot be checked, and NumPy cannot standardise it.
        concrete = is_concrete(image) and is_concrete(weight)
        xp, convert = (np, as_float64) if concrete else (jnp, as_real)
        pixels = convert("image", image)
        if pixels.ndim != 2 or min(pixels.shape) < _SPLINE_POINTS:
            raise ValueError(
                "Argument `image` must be two-dimensional and at least 6 × 6 pixels, but its shape is "
                f"{pixels.shape}."
            )
        weights = xp.ones_like(pixels) if weight is None else convert("weight", weight)
        check_shape("weight", weights, pixels.shape)
        if concrete and (not (weights >= 0).all() or not weights.sum() > 0):
            raise ValueError(
                "Argument `weight` must be at least 0 everywhere and positive somewhere."
            )
        check_number("psf_width", psf_width, above=0)
        check_integer("points_per_edge", points_per_edge, at_least=1)
        weights = weights / weights.sum()
        if fit_intensity:
            mean = (weights * pixels).sum()
            deviation = xp.sqrt((weights * (pixels - mean) ** 2).sum())
            rounding = 100 * float(jnp.finfo(pixels.dtype).eps)
            if concrete and not deviation > rounding * np.abs(pixels).max():
                raise ValueError("Argument `image` must not be constant, but is constant.")
            pixels = (pixels - mean) / deviation
        self.image = jnp.asarray(pixels)
        self.psf_width = jnp.asarray(psf_width, self.image.dtype)
        self.weight = jnp.asarray(weights)
        self.points_per_edge = points_per_edge
        self.fit_intensity = fit_intensity
        if pixel_size is not None:
            check_number("pixel_size", pixel_size, above=0)
        self.pixel_size = None if pixel_size is None else jnp.asarray(pixel_size, self.image.dtype)

    def residuals(self, tissue: Tissue, energy: AbstractEnergy) -> Float[Array, " residuals"]:
        """Difference of the images at each pixel, times the square root of its normalised weight."""
        shape = (self.image.shape[0], self.image.shape[1])
        model = render(
            tissue,
            shape,
            self.psf_width,
            points_per_edge=self.points_per_edge,
            pixel_size=self.pixel_size,
        )
        if self.fit_intensity:
            mean = lambda x: jnp.sum(self.weight * x)
            model = model - mean(model)
            scale = jnp.maximum(mean(model * self.image), 0) / mean(model**2)
            model = scale * model
        return (jnp.sqrt(self.weight) * (model - self.image)).ravel()

    def is_measurement(self, tissue: Tissue, energy: AbstractEnergy) -> Bool[Array, " residuals"]:
        """Which pixels have a positive weight."""
        return self.weight.ravel() > 0


def mirror(image: np.ndarray) -> np.ndarray:
    """Extend an image by its mirror images to a periodic image of twice the height and width.

    The paper makes micrographs periodic in this way. Use it with
    `vertax.initialise.from_labels(…, boundary="mirrored")`.

    **Arguments:**

    - `image`: shape (rows, columns).

    **Returns:** the image, the original at the top left.

    **Raises:**

    - `ValueError` for an image that is not two-dimensional.
    """
    if np.ndim(image) != 2:
        raise ValueError(
            f"Argument `image` must have shape (rows, columns), but its shape is {np.shape(image)}."
        )
    image = np.concatenate([image, image[:, ::-1]], axis=1)
    return np.concatenate([image, image[::-1]], axis=0)
