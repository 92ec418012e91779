"""Lengths and areas of a tissue on a curved surface."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vertax._base.checks import check_instance
from vertax._base.half_edges import clockwise
from vertax._base.indexing import take
from vertax._base.tracing import is_concrete
from vertax.mesh._boundary import AbstractBoundary, Periodic
from vertax.mesh._topology import Topology
from vertax.surfaces import AbstractSurface

# An edge is the chord in space between its ends. A cell is the part of the surface above its polygon in the
# chart: a fan of triangles (c, a, b) about a centre c, with the planar areas p,
#
#     A = Σ p/3 (ρ((a+b)/2) + ρ((c+a)/2) + ρ((c+b)/2)),    ρ = √det(JᵀJ),
#
# exact for a ρ that is quadratic in the chart (so the centre changes A by the fourth order only). Sums of
# areas of triangles in space would have a kink where a triangle vanishes, as at a four-fold vertex.
#
# The centre is the mean of the midpoints of the sides, weighted by their squared lengths in the chart: a side
# that vanishes or appears in a T1 transition does not change it, so A is continuous there.

Segments = tuple[Float[Array, " edges"], ...]


def space_chords(surface: AbstractSurface, segments: Segments) -> Float[Array, "edges 3"]:
    """The chord of each edge in space."""
    x, y, dx, dy = segments
    ends = jnp.stack([jnp.stack([x, x + dx]), jnp.stack([y, y + dy])], axis=-1)
    first, second = surface.points(ends).astype(ends.dtype)
    return second - first


def area_shares(
    surface: AbstractSurface,
    topology: Topology,
    boundary: AbstractBoundary,
    segments: Segments,
) -> tuple[Float[Array, " edges"], Float[Array, " edges"]]:
    """Contributions of each edge to the areas of its left and right cell."""
    m = topology
    x, y, dx, dy = segments
    n_edges, sides = len(x), m.edge_cells.T
    # Both sides of each edge in one array. (The frame of the right cell is that of its corner at the first
    # vertex, one slot clockwise.)
    corners = jnp.concatenate([m.half_edge, clockwise(m.half_edge)])
    vector = jnp.tile(jnp.stack([dx, dy], axis=-1), (2, 1))
    raw = jnp.tile(jnp.stack([x, y], axis=-1), (2, 1))
    start = raw + boundary.translation(take(m.frame, corners))
    weight = jnp.sum(vector**2, axis=-1, keepdims=True)
    moments = jnp.concatenate([weight, weight * (start + 0.5 * vector)], axis=-1)
    sums = jax.ops.segment_sum(moments, sides.ravel(), m.n_cells)
    centres = sums[:, 1:] / jnp.where(sums[:, :1] > 0, sums[:, :1], 1)
    # (The exterior has no centre.)
    centre = centres.at[sides.ravel()].get(mode="fill", fill_value=0)
    arm = start - centre
    planar = 0.5 * (arm[:, 0] * vector[:, 1] - arm[:, 1] * vector[:, 0])
    half = centre + 0.5 * arm
    places = [raw[:n_edges] + 0.5 * vector[:n_edges], half, half + 0.5 * vector]
    density = surface.density(jnp.concatenate(places)).astype(x.dtype)
    middle, first, second = jnp.split(density, [n_edges, 3 * n_edges])
    shares = planar * (jnp.tile(middle, 2) + first + second) / 3
    return shares[:n_edges], -shares[n_edges:]


def check_surface(
    surface: AbstractSurface,
    vertices: Float[Array, "vertices 2"],
    boundary: AbstractBoundary,
    arcs: bool,
) -> None:
    """Raise an error unless a tissue can lie on a surface. Values are checked if they are concrete.

    **Raises:**

    - `TypeError` for an object that is not a surface.
    - `ValueError` for a tissue with arcs, vertices outside of the chart, points that are not finite, or a
        surface with another period than the box.
    """
    expected = "a surface, e.g. vertax.surfaces.Cylinder(3.0), or None"
    check_instance("surface", surface, AbstractSurface, expected)
    if arcs:
        raise ValueError(
            "Argument `surface` must be None in a tissue with arcs: edges on a surface are straight chords. "
            "Make the tissue without `angles`."
        )
    if not all(map(is_concrete, jax.tree.leaves((surface, vertices, boundary)))):
        return
    surface.check(vertices)
    points, density = surface.sampled(vertices)
    if not (np.isfinite(points).all() and np.isfinite(density).all()):
        raise ValueError(
            "Argument `surface` must have finite points and tangents below all vertices, but has NaN or "
            "infinity."
        )
    if not isinstance(boundary, Periodic):
        return
    lattice = np.asarray(boundary.lattice)
    size = np.sqrt(np.abs(np.linalg.det(lattice)))
    for k, vector in enumerate(boundary.lattice):
        moved, changed = surface.sampled(vertices + vector)
        step = moved - points
        unequal = np.abs(step - step[:1]).max() / size + np.abs(changed / density - 1).max()
        if unequal > _PERIOD_TOLERANCE[vertices.dtype.itemsize > 4]:
            raise ValueError(
                "Argument `surface` must have the period of the box, but along lattice vector "
                f"{k}, {lattice[k].round(6).tolist()}, its points move by different vectors (relative "
                f"difference {unequal:.1g}). A cylinder of radius R needs a box of width 2πR, a periodic "
                "HeightMap a box of the size of its picture."
            )


_PERIOD_TOLERANCE = (1e-3, 1e-6)
"""Largest relative difference between the points of two periods, in 32 and 64 bits."""
