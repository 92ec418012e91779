"""The coarse part of a preconditioner: an elastic medium."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, PyTree

from vertax._base.indexing import take
from vertax._base.plane import inverse_of
from vertax._base.rows import Rows
from vertax._base.sums import total
from vertax.mesh import Periodic, Tissue

# (With one point for four cells a gradient takes a quarter more products with the Hessian.)
_CELLS_PER_POINT = 1


class ElasticMedium(eqx.Module):
    r"""An approximate inverse of the Hessian of a tissue, for conjugate gradients and MINRES.

    The number of iterations of a Krylov method is proportional to the wave length of the softest mode, in
    cells: about a thousand for $10^4$ cells. At long wave lengths a tissue is an elastic medium, which is
    diagonal in Fourier space:

    1. Distribute the residual to a grid with about one point for each cell.
    2. Divide transverse waves by $a + \mu k^2$ and longitudinal waves by $a + \lambda k^2$.
    3. Interpolate the result at the vertices, and add the response of the local part.

    $a$, $\mu$ and $\lambda$ are measured by two products with the Hessian. The inverse is symmetric and
    positive definite whatever the Hessian is, so it changes the number of iterations, not the solution.

    (Additive two-level method: Bramble, Pasciak & Xu 1990, doi:10.1090/S0025-5718-1990-1023042-6, with the
    coarse level solved by Fourier transforms.)
    """

    indices: Int[Array, "vertices 4"]
    """The points of the grid around each vertex."""
    weights: Float[Array, "vertices 4"]
    """Their weights; 0 for pinned vertices."""
    places: Float[Array, "vertices 2"]
    """Vertices in units of the box."""
    reciprocal: Float[Array, "2 2"]
    """The reciprocal lattice vectors, as rows."""
    vectors: Float[Array, "size size 2"]
    """The wave vectors of the grid."""
    filled: Float[Array, ""]
    """Vertices for each point of the grid."""
    size: int = eqx.field(static=True)

    min_cells: ClassVar[int] = 150
    """In smaller tissues it takes more time than it saves. (A class attribute, because a benchmark changes
    it.)"""

    @classmethod
    def of(cls, tissue: Tissue) -> ElasticMedium | None:
        """The medium of a tissue; None if the tissue is small."""
        if tissue.n_cells < cls.min_cells:
            return None
        size = _good_size(tissue.n_cells)
        lattice, origin = _box(tissue)
        inverse = inverse_of(lattice)
        x, y = (tissue.vertices - origin).T
        places = x[:, None] * inverse[0] + y[:, None] * inverse[1]
        scaled = size * places
        corner = jnp.floor(scaled)
        offset, corner = scaled - corner, corner.astype(int)
        points = jnp.stack([corner, corner + 1], axis=-1) % size
        shares = jnp.stack([1 - offset, offset], axis=-1)
        indices = size * points[:, 0, :, None] + points[:, 1, None, :]
        weights = shares[:, 0, :, None] * shares[:, 1, None, :]
        free = jnp.ones(tissue.n_vertices) if tissue.held is None else ~tissue.held
        free = free.astype(weights.dtype)
        numbers = np.fft.fftfreq(size, 1 / size)[:, None]
        reciprocal = 2 * jnp.pi * inverse.T
        first, second = (numbers * row for row in reciprocal)
        # (A part of the box of an open tissue is empty.)
        fill = jnp.sum(tissue.areas) / jnp.abs(jnp.linalg.det(lattice))
        return cls(
            indices=indices.reshape(-1, 4),
            weights=free[:, None] * weights.reshape(-1, 4),
            places=places,
            reciprocal=reciprocal,
            vectors=(first[:, None] + second).astype(weights.dtype),
            filled=jnp.sum(free) / (fill * size**2),
            size=size,
        )

    @property
    def blank(self) -> Stiffness:
        """A placeholder for the result of `set_up`."""
        one = jnp.ones_like(self.filled)
        return Stiffness(one, one, one)

    def set_up(
        self, hessian: Callable[[PyTree], PyTree], like: PyTree, stiffness: Float[Array, ""]
    ) -> Stiffness:
        """The stiffness of waves in a tissue; bounded from below by 1e-4 of that of a vertex.

        **Arguments:**

        - `hessian`: multiplies by the Hessian.
        - `like`: a configuration, or its shapes.
        - `stiffness`: the mean stiffness of a vertex.
        """
        squares = jnp.sum(self.reciprocal**2, axis=-1)
        floor = 1e-4 * stiffness / (jnp.max(squares) * (self.size / 2) ** 2)
        directions = self.reciprocal / jnp.sqrt(squares)[:, None]
        across = jnp.stack([-directions[:, 1], directions[:, 0]], axis=-1)
        free = jnp.sum(self.weights, axis=-1, keepdims=True)
        shapes = jax.tree.leaves(like)[1:]

        long, short = 1, max(2, self.size // 8)

        def waves(number: int, polarisations: Float[Array, "2 2"]) -> Float[Array, "vertices 2"]:
            phases = number * self.places + jnp.array([0.05, 0.18], self.places.dtype)
            return free * total(_wave(phases[:, i, None]) * polarisations[i] for i in (0, 1))

        # Both wave lengths of one polarisation in one product: they are nearly orthogonal.
        def measure(each: Float[Array, "kinds vertices 2"]) -> Float[Array, " kinds"]:
            rest = [jnp.zeros(x.shape, x.dtype) for x in shapes]
            leaves = [total(each), *rest]
            product = hessian(jax.tree.unflatten(jax.tree.structure(like), leaves))
            force = jax.tree.leaves(product)[0]
            return jnp.stack([jnp.vdot(wave, force) / jnp.vdot(wave, wave) for wave in each])

        # (In a loop, so that the product is compiled once.)
        each = jnp.stack(
            [jnp.stack([waves(n, way) for n in (long, short)]) for way in (directions, across)]
        )
        (far, near), (far_across, near_across) = jax.lax.map(measure, each)
        square = jnp.mean(squares)

        def law(far: Array, near: Array, least: Array) -> tuple[Array, Array]:
            slope = jnp.maximum((near - far) / (square * (short**2 - long**2)), least)
            return jnp.maximum(far - slope * square * long**2, 0), slope

        offset, compression = law(far, near, floor)
        other, shear = law(far_across, near_across, jnp.maximum(floor, 1e-3 * compression))
        return Stiffness(jnp.minimum(offset, other), shear, compression)

    def approximate_inverse(
        self,
        measured: Stiffness,
        damping: Float[Array, ""] | float = 0.0,
        shares: Rows | None = None,
    ) -> MediumInverse:
        """The inverse for a damping.

        **Arguments:**

        - `measured`: the result of `set_up`.
        - `damping`: the stiffness of a spring at each vertex.
        - `shares`: the fraction of the force, and of the motion, of each row that counts; None for all.
        """
        # Vectors are complex numbers: that halves the number of transforms. If Z(k) is a transform, its
        # longitudinal part is (Z(k) + κ/κ* Z*(-k)) / 2 with κ = k_x + i k_y; the rest is transverse.
        offset, shear, compression = measured
        x, y = self.vectors[..., 0], self.vectors[..., 1]
        squared = x**2 + y**2
        uniform = squared == 0
        squared = jnp.where(uniform, 1, squared)
        along, across = (1 / (offset + damping + c * squared) for c in (compression, shear))
        scale = jnp.where(uniform, 0, 0.5 / self.filled)
        turned = jax.lax.complex(x**2 - y**2, 2 * x * y) / squared
        weights = self.weights
        if shares is not None:
            weights *= jax.tree.leaves(shares)[0][:, None]
        mirrored = scale * (along - across) * turned
        return MediumInverse(self.indices, weights, scale * (along + across), mirrored)

    def apply(self, inverse: MediumInverse, local: PyTree, force: PyTree) -> PyTree:
        """The response to a force, together with that of the local part of the preconditioner."""
        first, *rest = jax.tree.leaves(local)
        first = first + inverse(jax.tree.leaves(force)[0])
        return jax.tree.unflatten(jax.tree.structure(local), [first, *rest])


class Stiffness(NamedTuple):
    """The stiffness $a$, $\\mu$ and $\\lambda$ of waves, see `ElasticMedium`."""

    offset: Float[Array, ""]
    shear: Float[Array, ""]
    compression: Float[Array, ""]


class MediumInverse(eqx.Module):
    """The approximate inverse of `ElasticMedium` for one damping."""

    indices: Int[Array, "vertices 4"]
    weights: Float[Array, "vertices 4"]
    direct: Float[Array, "size size"]
    """The factor of each wave."""
    mirrored: Complex[Array, "size size"]
    """The factor of the complex conjugate of the wave in the opposite direction."""

    def __call__(self, force: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """The displacement of vertices by forces on them."""
        spread = self.weights[:, :, None] * force[:, None, :]
        grid = jnp.zeros((self.direct.size, 2), force.dtype).at[self.indices].add(spread)
        grid = jax.lax.complex(grid[:, 0], grid[:, 1]).reshape(self.direct.shape)
        modes = jnp.fft.fft2(grid)
        opposite = jnp.roll(modes[::-1, ::-1], 1, axis=(0, 1)).conj()
        moved = jnp.fft.ifft2(self.direct * modes + self.mirrored * opposite).ravel()
        moved = jnp.stack([moved.real, moved.imag], axis=-1).astype(force.dtype)
        return total(self.weights[:, i, None] * take(moved, self.indices[:, i]) for i in range(4))


def _wave(phase: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The cosine of a phase in turns to 1 %, ten times as fast."""
    t = 2 * jnp.abs(phase - jnp.round(phase))
    return 1 - t**2 * (6 - 4 * t)


def _box(tissue: Tissue) -> tuple[Float[Array, "2 2"], Float[Array, "2"]]:
    """The box of a periodic tissue, or one around an open tissue with some room; and its origin."""
    if isinstance(tissue.boundary, Periodic):
        return tissue.boundary.lattice, jnp.zeros(2, tissue.vertices.dtype)
    points = tissue.gathered(tissue.vertices)
    least, most = jnp.min(points, axis=0), jnp.max(points, axis=0)
    return jnp.diag(1.2 * (most - least)), least - 0.1 * (most - least)


def _good_size(n_cells: int) -> int:
    """The number of points of a side: odd, with small factors.

    (An even number has a highest wave that is its own mirror image.)
    """
    size = int(np.ceil(np.sqrt(n_cells / _CELLS_PER_POINT))) | 1
    while _rest(size) > 1:
        size += 2
    return size


def _rest(number: int) -> int:
    for factor in (3, 5, 7, 11, 13):
        while number % factor == 0:
            number //= factor
    return number
