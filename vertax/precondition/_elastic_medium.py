"""A preconditioner that knows what a tissue is in the large: an elastic medium."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from vertax._base.sums import total
from vertax.mesh import Periodic, Tissue
from vertax.mesh._boundary import inverse_of
from vertax.mesh._topology import take
from vertax.solvers._rows import Rows

# (A point for four cells takes a quarter more products with the Hessian of a gradient.)
_CELLS_A_POINT = 1


class ElasticMedium(eqx.Module):
    r"""An approximate inverse of the Hessian of a tissue, for conjugate gradients and MINRES.

    Krylov methods take as many steps as the wave length of the softest motion is long, in cells: in a tissue
    of $10^4$ cells a thousand. Long waves are those of an elastic medium, though, which Fourier transforms
    solve. So the residual goes to a grid of about a point for each cell, is divided there by

    $$a + \mu k^2 \text{ (transverse waves)}, \qquad a + \lambda k^2 \text{ (longitudinal waves)},$$

    and comes back; to this is added the residual over the mean stiffness, for all that is as small as
    cells. Stiffnesses $a, \mu, \lambda$ are those of waves in this tissue, from two products with its
    Hessian. It is symmetric and positive definite whatever the Hessian is, so it changes the number of steps
    and not where they lead.

    (Additive two-level method: Bramble, Pasciak & Xu 1990, doi:10.1090/S0025-5718-1990-1023042-6, with the
    coarse level solved by Fourier transforms.)
    """

    indices: Int[Array, "vertices 4"]
    """The points of the grid around each vertex,"""
    weights: Float[Array, "vertices 4"]
    """and how much each of them counts; 0 for vertices that do not move."""
    places: Float[Array, "vertices 2"]
    """Vertices in units of the box."""
    reciprocal: Float[Array, "2 2"]
    """The reciprocal lattice vectors, as rows."""
    vectors: Float[Array, "size size 2"]
    """The wave vectors that the grid knows."""
    filled: Float[Array, ""]
    """Vertices for each point of the grid."""
    size: int = eqx.field(static=True)

    min_cells: ClassVar[int] = 150
    """The smallest tissue that is preconditioned: smaller ones have no slow waves, so it costs more than it
    saves. (A class attribute, because a benchmark changes it: a module constant could have copies.)"""

    @classmethod
    def of(cls, tissue: Tissue) -> ElasticMedium | None:
        """Those of a tissue as it is now; None if it is small."""
        if tissue.n_cells < cls.min_cells:
            return None
        size = _good_size(tissue.n_cells)
        lattice, origin = _box(tissue)
        inverse = inverse_of(lattice)
        x, y = (tissue.vertices - origin).T
        places = x[:, None] * inverse[0] + y[:, None] * inverse[1]
        scaled = size * places
        corner = jnp.floor(scaled)
        beyond, corner = scaled - corner, corner.astype(int)
        near = jnp.stack([corner, corner + 1], axis=-1) % size
        shares = jnp.stack([1 - beyond, beyond], axis=-1)
        indices = size * near[:, 0, :, None] + near[:, 1, None, :]
        weights = shares[:, 0, :, None] * shares[:, 1, None, :]
        moves = jnp.ones(tissue.n_vertices) if tissue.held is None else ~tissue.held
        moves = moves.astype(weights.dtype)
        numbers = np.fft.fftfreq(size, 1 / size)[:, None]
        reciprocal = 2 * jnp.pi * inverse.T
        first, second = (numbers * row for row in reciprocal)
        # Of an open tissue's box a part is empty.
        fill = jnp.sum(tissue.areas) / jnp.abs(jnp.linalg.det(lattice))
        return cls(
            indices=indices.reshape(-1, 4),
            weights=moves[:, None] * weights.reshape(-1, 4),
            places=places,
            reciprocal=reciprocal,
            vectors=(first[:, None] + second).astype(weights.dtype),
            filled=jnp.sum(moves) / (fill * size**2),
            size=size,
        )

    @property
    def ready(self) -> Bool[Array, ""]:
        """Whether there is anything to precondition with: always."""
        return jnp.array(True)

    @property
    def unmeasured(self) -> Stiffness:
        """What stands for what is not measured."""
        one = jnp.ones_like(self.filled)
        return Stiffness(one, one, one)

    def measured(
        self, hessian: Callable[[PyTree], PyTree], like: PyTree, mean: Float[Array, ""]
    ) -> Stiffness:
        """The stiffness of waves in a tissue.

        **Arguments:**

        - `hessian`: its products with vectors.
        - `like`: a configuration, or its shapes.
        - `mean`: the mean stiffness of a vertex; no wave is taken to be much softer.
        """
        squares = jnp.sum(self.reciprocal**2, axis=-1)
        floor = 1e-4 * mean / (jnp.max(squares) * (self.size / 2) ** 2)
        directions = self.reciprocal / jnp.sqrt(squares)[:, None]
        across = jnp.stack([-directions[:, 1], directions[:, 0]], axis=-1)
        moves = jnp.sum(self.weights, axis=-1, keepdims=True)
        shapes = jax.tree.leaves(like)[1:]

        long, short = 1, max(2, self.size // 8)

        def waves(number: int, polarisations: Float[Array, "2 2"]) -> Float[Array, "vertices 2"]:
            phases = number * self.places + jnp.array([0.05, 0.18])
            return moves * total(_wave(phases[:, i, None]) * polarisations[i] for i in (0, 1))

        # All of one polarisation in one product, for they hardly feel each other.
        def stiffness(each: Float[Array, "kinds vertices 2"]) -> Float[Array, " kinds"]:
            rest = [jnp.zeros(x.shape, x.dtype) for x in shapes]
            leaves = [total(each), *rest]
            product = hessian(jax.tree.unflatten(jax.tree.structure(like), leaves))
            force = jax.tree.leaves(product)[0]
            return jnp.stack([jnp.vdot(wave, force) / jnp.vdot(wave, wave) for wave in each])

        # (One after the other, so that the Hessian is compiled once.)
        each = jnp.stack(
            [jnp.stack([waves(n, way) for n in (long, short)]) for way in (directions, across)]
        )
        (far, near), (far_across, near_across) = jax.lax.map(stiffness, each)
        square = jnp.mean(squares)

        def law(far: Array, near: Array, least: Array) -> tuple[Array, Array]:
            slope = jnp.maximum((near - far) / (square * (short**2 - long**2)), least)
            return jnp.maximum(far - slope * square * long**2, 0), slope

        offset, compression = law(far, near, floor)
        other, shear = law(far_across, near_across, jnp.maximum(floor, 1e-3 * compression))
        return Stiffness(jnp.minimum(offset, other), shear, compression)

    def compliance(
        self,
        stiffness: Stiffness,
        shift: Float[Array, ""] | float = 0.0,
        shares: Rows | None = None,
    ) -> Compliance:
        """How the medium gives way if a spring of stiffness `shift` holds each vertex besides.

        Vertices hand on a share of their force to the medium, and go with it as much; all by default.
        """
        # Vectors are complex numbers, so half the transforms do. If Z(k) is a transform, the part of the
        # vectors' transform along k is (Z(k) + κ/κ* Z*(-k)) / 2 with κ = k_x + i k_y, the rest across.
        offset, shear, compression = stiffness
        x, y = self.vectors[..., 0], self.vectors[..., 1]
        squared = x**2 + y**2
        whole = squared == 0
        squared = jnp.where(whole, 1, squared)
        along, across = (1 / (offset + shift + c * squared) for c in (compression, shear))
        scale = jnp.where(whole, 0, 0.5 / self.filled)
        turned = jax.lax.complex(x**2 - y**2, 2 * x * y) / squared
        weights = self.weights
        if shares is not None:
            weights *= jax.tree.leaves(shares)[0][:, None]
        mirrored = scale * (along - across) * turned
        return Compliance(self.indices, weights, scale * (along + across), mirrored)

    def added(self, compliance: Compliance, near: PyTree, force: PyTree) -> PyTree:
        """How vertices give way near by, as parts of a configuration, and how the medium does besides."""
        first, *rest = jax.tree.leaves(near)
        first = first + compliance(jax.tree.leaves(force)[0])
        return jax.tree.unflatten(jax.tree.structure(near), [first, *rest])


class Stiffness(NamedTuple):
    """What waves in a tissue resist with; see `ElasticMedium`."""

    offset: Float[Array, ""]
    shear: Float[Array, ""]
    compression: Float[Array, ""]


class Compliance(eqx.Module):
    """How a medium gives way to forces on vertices."""

    indices: Int[Array, "vertices 4"]
    weights: Float[Array, "vertices 4"]
    direct: Float[Array, "size size"]
    """What comes of each wave along its own wave vector,"""
    mirrored: Complex[Array, "size size"]
    """and of the one in the opposite direction."""

    def __call__(self, force: Float[Array, "vertices 2"]) -> Float[Array, "vertices 2"]:
        """How it gives way to forces on vertices."""
        spread = self.weights[:, :, None] * force[:, None, :]
        grid = jnp.zeros((self.direct.size, 2), force.dtype).at[self.indices].add(spread)
        grid = jax.lax.complex(grid[:, 0], grid[:, 1]).reshape(self.direct.shape)
        modes = jnp.fft.fft2(grid)
        opposite = jnp.roll(modes[::-1, ::-1], 1, axis=(0, 1)).conj()
        moved = jnp.fft.ifft2(self.direct * modes + self.mirrored * opposite).ravel()
        moved = jnp.stack([moved.real, moved.imag], axis=-1).astype(force.dtype)
        return total(self.weights[:, i, None] * take(moved, self.indices[:, i]) for i in range(4))


def _wave(phase: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """A cosine to one part in a hundred, of a phase in turns: the cosine itself takes ten times as long."""
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
    """How many points a side has: an odd number with small factors.

    (Without a highest wave, which is its own mirror image.)
    """
    size = int(np.ceil(np.sqrt(n_cells / _CELLS_A_POINT))) | 1
    while _rest(size) > 1:
        size += 2
    return size


def _rest(number: int) -> int:
    for factor in (3, 5, 7, 11, 13):
        while number % factor == 0:
            number //= factor
    return number
