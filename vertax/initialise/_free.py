"""Free clusters of cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vertax._base.checks import as_key, check_concrete, check_integer
from vertax.initialise._overlap_repair import repair_overlaps
from vertax.initialise._spatial_order import spatial_order
from vertax.initialise._voronoi import tessellate
from vertax.mesh import Free, Tissue, Topology
from vertax.mesh._arcs import angle_of_area


def free_voronoi(
    n_cells: int,
    *,
    key: PRNGKeyArray | int,
    lloyd_steps: int = 0,
    random_angles: bool = False,
    inner_arcs: bool = False,
    softening: float | None = None,
) -> Tissue:
    r"""A round cluster of Voronoi cells with arcs on its outline (paper, Methods, "Mesh initialization").

    The cells of those random seeds that are nearest to the origin, among enough of them, one for each
    unit of area. These hang together and enclose no hole. What of a cell's outline lies between two
    junctions becomes one arc, which keeps the area of the cell (up to nearly a whole circle).

    **Arguments:**

    - `n_cells`: number of cells, at least two. (Three edges meet at every vertex, and a single free cell
        has none.)
    - `key`: a key from `jax.random.key`, or a whole number as its seed.
    - `lloyd_steps`: number of Lloyd iterations, which make the cells more regular.
    - `random_angles`: draw the angles of the arcs uniformly from 0 to $\pi/2$, as in the paper.
    - `inner_arcs`, `softening`: passed on to [`Tissue`][vertax.Tissue].

    **Returns:** a [`Tissue`][vertax.Tissue] with a [`Free`][vertax.Free] boundary.

    **Raises:**

    - `ValueError` for fewer than two cells, or a negative number of Lloyd iterations.
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`: how a tissue is
        connected depends on numbers, which are not known there.
    """
    check_concrete("free_voronoi", key)
    if n_cells == 1 and n_cells is not True:
        raise ValueError(
            "Argument `n_cells` must be at least 2, but is 1: three edges meet at every vertex of a "
            "tissue, and a single free cell has none. Begin with two cells, or with one in a periodic box: "
            "vx.initialise.periodic_voronoi(1, key=0)."
        )
    check_integer("n_cells", n_cells, at_least=2)
    check_integer("lloyd_steps", lloyd_steps, at_least=0)
    dtype = jnp.result_type(float)
    # A periodic box of seeds, so that no cell is unbounded, with a margin of three cells.
    n_seeds = int(np.ceil((2 * np.sqrt(n_cells / np.pi) + 6) ** 2))
    box = np.sqrt(n_seeds) * np.eye(2)
    seed_key, angle_key = jax.random.split(as_key(key))
    fractions = np.asarray(jax.random.uniform(seed_key, (n_seeds, 2), dtype), float)
    seeds = (fractions[spatial_order(fractions)] - 0.5) @ box
    seeds, vertices, topology = tessellate(seeds, box, lloyd_steps)
    # Seeds in a disk have cells whose union is a disk. On the way from a seed p straight to the centre
    # the nearest seed is always at least as central as p, as the circle about the way point through p
    # lies within that about the centre; and outwards from a seed that is left out, never more central.
    chosen = np.zeros(n_seeds, bool)
    chosen[np.argsort(np.sum(seeds**2, axis=1))[:n_cells]] = True
    corners = np.repeat(vertices, 3, axis=0) + np.asarray(topology.frame) @ box
    vertices, topology, angles = _cut_out(corners, topology, chosen)
    if random_angles:
        angles = jax.random.uniform(angle_key, angles.shape, dtype, maxval=np.pi / 2)

    def made(vertices: Float[Array, "vertices 2"], angles: Float[Array, " edges"] | None) -> Tissue:
        # The default softening follows from the areas, and these from the angles.
        return Tissue(vertices, topology, Free(), softening, angles=angles, inner_arcs=inner_arcs)

    tissue = made(jnp.asarray(vertices, dtype), jnp.asarray(angles, dtype))
    tidy = repair_overlaps(tissue)
    return tissue if tidy is tissue else made(tidy.vertices, tidy.angles)


def _cut_out(
    corners: Float[np.ndarray, "halfedges 2"],
    topology: Topology,
    chosen: Bool[np.ndarray, " cells"],
) -> tuple[Float[np.ndarray, "vertices 2"], Topology, Float[np.ndarray, " edges"]]:
    """The cluster of the chosen cells: vertices, topology and the angles of its arcs."""
    cell, twin = np.asarray(topology.cell), np.asarray(topology.twin)
    inside = chosen[cell]
    # Junctions are where two or three chosen cells meet; all of their three edges stay. Where one
    # chosen cell meets two others its outline goes on.
    junction = np.sum(inside.reshape(-1, 3), axis=1) >= 2
    here = np.flatnonzero(np.repeat(junction, 3))
    # From each junction along its edge, around the chosen cell on the left, to the next junction. On the
    # way sum up what the outline encloses with the origin.
    here = here[inside[here]]
    following = np.asarray(topology.next)
    last, swept = here.copy(), np.zeros(len(here))
    walking = np.ones(len(here), bool)
    while walking.any():
        step = 0.5 * _cross(corners[last], corners[following[last]])
        swept[walking] += step[walking]
        walking &= ~junction[twin[last] // 3]
        last = np.where(walking, following[last], last)
    chord = corners[following[last]] - corners[here]
    bulge = swept - 0.5 * _cross(corners[here], chord)

    number = np.cumsum(junction) - 1
    rename = lambda h: 3 * number[h // 3] + h % 3
    n_half = 3 * int(junction.sum())
    new_twin, new_cell = np.empty(n_half, int), np.full(n_half, chosen.sum())
    vertices = np.empty((n_half // 3, 2))
    first, other = rename(here), rename(twin[last])
    new_twin[first], new_twin[other] = other, first
    new_cell[first] = (np.cumsum(chosen) - 1)[cell[here]]
    vertices[first // 3] = corners[here]
    cluster = Topology(new_twin, new_cell, np.zeros((n_half, 2), int), exterior=True)
    angles = np.zeros(cluster.n_edges)
    outline = new_cell[other] == chosen.sum()
    angle = angle_of_area(bulge[outline], np.linalg.norm(chord[outline], axis=1))
    angles[np.asarray(cluster.edge)[first[outline]]] = angle
    return vertices, cluster, angles


def _cross(p: Float[np.ndarray, "n 2"], q: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
