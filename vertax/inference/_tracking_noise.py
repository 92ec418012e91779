"""Estimate of the tracking noise of a movie."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vertax._base.announce import announced_jit
from vertax._base.indexing import take
from vertax.costs import matching_vertices
from vertax.inference._movie_equations import frame_at
from vertax.mesh import Tissue


@announced_jit
def tracking_noise(frames: Tissue, times: Float[Array, " frames"]) -> Float[Array, ""]:
    r"""Standard deviation $\sigma$ of the error of a coordinate, from vertices that survive six frames.

    Second differences $a_n = x_{n+1} - 2 x_n + x_{n-1}$ of positions with independent errors have

    $$\langle a_n a_{n+2} \rangle - \langle a_n a_{n+3} \rangle = \sigma^2.$$

    A random walk does not contribute, and a smooth motion contributes to both terms alike (compare the
    estimators of Vestergaard et al. 2014, doi:10.1103/PhysRevE.89.022726). Windows of six frames with unequal
    intervals are left out.

    **Returns:** $\sigma$; 0 if there is no such vertex.
    """
    if len(times) < 6:
        return jnp.zeros((), times.dtype)

    def one(first: Int[Array, ""]) -> tuple[Array, Array]:
        middle = frame_at(frames, first + 3)
        paths, use = [], jnp.all(middle.topology.cell.reshape(-1, 3) != middle.n_cells + 1, axis=1)
        for k in range(6):
            other = frame_at(frames, first + k)
            place, matched = matching_vertices(middle, other)
            paths.append(middle.boundary.shortest(take(other.vertices, place) - middle.vertices))
            use &= matched
        intervals = jnp.diff(jax.lax.dynamic_slice(times, (first,), (6,)))
        use &= jnp.ptp(intervals) < 0.01 * jnp.mean(intervals)
        curvature = jnp.diff(jnp.stack(paths), n=2, axis=0)
        product = jnp.sum(curvature[0] * (curvature[2] - curvature[3]), axis=-1) / 2
        return jnp.sum(jnp.where(use, product, 0)), jnp.sum(use)

    sums, counts = jax.lax.map(one, jnp.arange(len(times) - 5))
    return jnp.sqrt(jnp.maximum(jnp.sum(sums) / jnp.maximum(jnp.sum(counts), 1), 0))
