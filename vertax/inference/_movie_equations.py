"""Equations of the fit of a movie: residuals of forces, instruments, and their sums."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from vertax._base.indexing import take
from vertax.costs import matching_vertices
from vertax.energies import AbstractEnergy
from vertax.mesh import Tissue


class Settings(eqx.Module):
    """The arguments of `fit_movie` that do not depend on the frames."""

    static: Any
    unravel: Any = eqx.field(static=True)
    friction: Float[Array, ""]
    noise: Float[Array, ""]
    implicitness: Float[Array, ""]
    min_edge_length: Float[Array, ""]
    """In units of length."""
    fit_friction: bool = eqx.field(static=True)
    outline: bool = eqx.field(static=True)
    most_nodes: int = eqx.field(static=True)
    """Largest number of nodes inside a side of the outline; 0 if they have no friction."""

    def energy(self, theta: Float[Array, " parameters"]) -> AbstractEnergy:
        parameters = theta[:-1] if self.fit_friction else theta
        return eqx.combine(self.unravel(parameters), self.static)

    def zeta(self, theta: Float[Array, " parameters"]) -> Float[Array, ""]:
        return theta[-1] if self.fit_friction else self.friction

    def slope(
        self, theta: Float[Array, " parameters"], tissue: Tissue
    ) -> Float[Array, "vertices 2"]:
        energy = self.energy(theta)
        return jax.grad(lambda x: energy(tissue.with_vertices(x)))(tissue.vertices)


class Solution(NamedTuple):
    """Parameters of each window, and how well they are determined."""

    theta: Float[Array, "windows parameters"]
    covariance: Float[Array, "windows parameters parameters"]
    misfit: Float[Array, " windows"]
    num_equations: Int[Array, " windows"]
    converged: Bool[Array, " windows"]
    slopes: Float[Array, "windows parameters parameters"]
    scales: Float[Array, "windows 2 parameters"]


def frame_at(frames: Tissue, number: Int[Array, ""]) -> Tissue:
    """One frame of a batch, also in a compiled function."""
    return jax.tree.map(lambda x: x[number] if eqx.is_array(x) else x, frames)


def equations(
    settings: Settings,
    theta: Float[Array, " parameters"],
    floor: Float[Array, ""],
    triple: list[Tissue],
    nodes: Int[Array, " edges"] | None,
    dt: Float[Array, ""],
    used: Bool[Array, ""],
) -> tuple[Array, ...]:
    """Of one step: ZᵀWr of each cell, ZᵀWG, the diagonals of ZᵀWZ and GᵀWG, and sums of squares.

    The sums are those of squared residuals and of variances by tracking, per component, and the number of
    vertices. `nodes` are those inside the edges of the last frame.
    """
    before, start, end = triple
    to_before, in_before = matching_vertices(end, before)
    to_start, in_start = matching_vertices(end, start)
    use = in_before & in_start & used
    shortest = before.edge_lengths[before.topology.edge.reshape(-1, 3)].min(axis=1)
    use &= take(shortest, to_before) > settings.min_edge_length
    cells = end.topology.cell.reshape(-1, 3)
    use &= jnp.all(cells != end.n_cells + 1, axis=1)
    if not settings.outline:
        outside = end.topology.cell[end.topology.twin] == end.n_cells
        outer = jnp.zeros(end.n_cells + 2, bool).at[end.topology.cell].max(outside)
        use &= ~jnp.any(outer[cells] | (cells == end.n_cells), axis=1)
    moved = end.boundary.shortest(end.vertices - take(start.vertices, to_start))
    if nodes is not None and settings.most_nodes:
        moved += moved_nodes(start, end, to_start, in_start, nodes, settings.most_nodes)
    velocity = moved / dt
    alpha = settings.implicitness

    def residual(theta: Array) -> tuple[Array, Array]:
        force = alpha * settings.slope(theta, end)
        force += (1 - alpha) * take(settings.slope(theta, start), to_start)
        r = settings.zeta(theta) * velocity + force
        return r, r

    def instrument(theta: Array) -> tuple[Array, Array]:
        force = settings.slope(theta, before)
        return force, force

    g, r = jax.jacfwd(residual, has_aux=True)(theta)
    z, force_before = jax.jacfwd(instrument, has_aux=True)(theta)
    z = take(z, to_before)
    zeta = settings.zeta(theta)
    if settings.fit_friction:
        # The velocity that the forces of the frame before predict.
        z = z.at[..., -1].set(-take(force_before, to_before) / zeta)
    slope_at = lambda x: settings.slope(theta, before.with_vertices(x))
    probes = jax.random.normal(jax.random.key(0), (_N_PROBES, *before.vertices.shape), r.dtype)
    product = lambda v: jax.jvp(slope_at, (before.vertices,), (v,))[1]
    spread = jnp.mean(jnp.sum(jax.vmap(product)(probes) ** 2, axis=-1), axis=0) / 2
    tracking = settings.noise**2 * (take(spread, to_before) + 2 * (zeta / dt) ** 2)
    clean = lambda x: jnp.where(use.reshape(-1, *[1] * (x.ndim - 1)), x, 0)
    r, g, z, tracking = clean(r), clean(g), clean(z), clean(tracking)
    w = use / (tracking + floor)
    # A vertex counts for its cell with the lowest number.
    owner = jnp.min(cells, axis=1)
    moments = jnp.einsum("vip,v,vi->vp", z, w, r)
    moments = jnp.zeros((end.n_cells + 2, theta.size), r.dtype).at[owner].add(moments)
    slopes = jnp.einsum("vip,v,viq->pq", z, w, g)
    scales = jnp.stack([jnp.einsum("vip,v,vip->p", x, w, x) for x in (z, g)])
    squares = jnp.stack([jnp.sum(r**2) / 2, jnp.sum(tracking), jnp.sum(use).astype(r.dtype)])
    return moments, slopes, scales, squares


def moved_nodes(
    start: Tissue,
    end: Tissue,
    to_start: Int[Array, " vertices"],
    in_start: Bool[Array, " vertices"],
    nodes: Int[Array, " edges"],
    most: int,
) -> Float[Array, "vertices 2"]:
    r"""Displacements of the nodes inside the sides of the outline, in the coordinates of their ends.

    The nodes divide the arc between $x_a$ and $x_b$ into equal parts, at $x_k = (1 - z_k) x_a + z_k x_b$ in
    complex numbers, with $z_k = e^{i \alpha (s - 1)} \sin(\alpha s) / \sin \alpha$ at the fraction $s$ of an
    arc of half-angle $\alpha$. Friction at the nodes is a force on the coordinates of the arc: that on $x_a$
    is $\sum_k (1 - \bar z_k) \dot x_k$ times the friction of a node, and $\sum_k \bar z_k \dot x_k$ on $x_b$.
    """
    a, b = end.topology.edge_vertices.T
    ends = to_start[jnp.stack([a, b])]
    # The side in the frame before: on the outline, with the same vertices.
    edges = start.topology.edge.reshape(-1, 3)[ends[0]]
    same = jnp.any(start.topology.edge_vertices[edges] == ends[1][:, None, None], axis=-1)
    same &= start.topology.on_outline[edges]
    before = jnp.take_along_axis(edges, jnp.argmax(same, axis=1)[:, None], axis=1)[:, 0]
    number = jnp.arange(1, most + 1)
    fraction = (number / (nodes[:, None] + 1)).astype(end.vertices.dtype)
    use = jnp.any(same, axis=1) & in_start[a] & in_start[b]
    use = use[:, None] & (number <= nodes[:, None])

    def weights(angles: Float[Array, " edges"]) -> Complex[Array, "edges nodes"]:
        angles = angles[:, None]
        ratio = jnp.sinc(angles * fraction / jnp.pi) / jnp.sinc(angles / jnp.pi)
        return jnp.exp(1j * angles * (fraction - 1)) * ratio * fraction

    def places(tissue: Tissue, ends: Array, angles: Array) -> Complex[Array, "edges nodes"]:
        x = tissue.vertices[ends, 0] + 1j * tissue.vertices[ends, 1]
        return x[0][:, None] + (x[1] - x[0])[:, None] * weights(angles)

    after = places(end, jnp.stack([a, b]), end.edge_angles)
    moved = jnp.where(use, after - places(start, ends, start.edge_angles[before]), 0)
    z, sums = jnp.conj(weights(end.edge_angles)), jnp.zeros(end.n_vertices, moved.dtype)
    sums = sums.at[a].add(((1 - z) * moved).sum(axis=1)).at[b].add((z * moved).sum(axis=1))
    return jnp.stack([sums.real, sums.imag], axis=-1)


_N_PROBES = 16
"""Random vectors that estimate the rows of a Hessian: weights within about 20 %."""


def scaled_inverse(
    slopes: Float[Array, "parameters parameters"], scales: Float[Array, "2 parameters"]
) -> tuple[Float[Array, "parameters parameters"], Bool[Array, " parameters"]]:
    """The pseudoinverse of ZᵀWG, scaled, and which parameters are determined."""
    size = jnp.sqrt(jnp.where(scales > 0, scales, 1))
    scaled = slopes / size[0][:, None] / size[1]
    inverse = jnp.linalg.pinv(scaled, rtol=max(1e-8, 100 * float(jnp.finfo(scaled.dtype).eps)))
    determined = jnp.diag(inverse @ scaled) > 1 - least_share(scaled.dtype)
    return inverse / size[1][:, None] / size[0], determined


def least_share(dtype: Any) -> float:
    """Share of a parameter in directions without information from which on it is undetermined."""
    return max(1e-6, 1e4 * float(jnp.finfo(dtype).eps))


def sandwich_covariance(
    moments: Float[Array, "steps cells parameters"],
    slopes: Float[Array, "parameters parameters"],
    scales: Float[Array, "2 parameters"],
    used: Bool[Array, " steps"],
) -> Float[Array, "parameters parameters"]:
    """Sandwich formula over steps and over cells.

    Over steps with a correlation of successive ones of weight 1/2; over cells the part by which the residuals
    of a cell have a common sign in time, as those of an error of the model.
    """
    of_steps, of_cells = moments.sum(axis=1), moments.sum(axis=0)
    following = of_steps[:-1].T @ of_steps[1:]
    middle = of_steps.T @ of_steps + 0.5 * (following + following.T)
    independent = jnp.einsum("scp,scq->pq", moments, moments)
    size = jnp.sqrt(jnp.where(jnp.diag(independent) > 0, jnp.diag(independent), 1))
    size = size[:, None] * size
    values, vectors = jnp.linalg.eigh((of_cells.T @ of_cells - independent) / size)
    middle += (vectors * jnp.maximum(values, 0)) @ vectors.T * size
    inverse, determined = scaled_inverse(slopes, scales)
    n_steps, n_parameters = used.sum(), len(slopes)
    factor = jnp.where(
        n_steps > n_parameters, n_steps / jnp.maximum(n_steps - n_parameters, 1), jnp.nan
    )
    covariance = factor * inverse @ middle @ inverse.T
    both = determined[:, None] & determined
    infinite = jnp.where(jnp.eye(n_parameters, dtype=bool), jnp.inf, 0)
    return jnp.where(both, covariance, infinite.astype(covariance.dtype))
