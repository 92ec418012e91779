"""Free clusters of cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vertax._base.checks import as_key, check_concrete, check_integer
from vertax._base.plane import cross
from vertax.initialise._overlap_repair import repair_overlaps
from vertax.initialise._spatial_order import spatial_order
from vertax.initialise._voronoi import tessellate
from vertax.mesh import Free, Tissue, Topology, angle_of_area


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

    Of random seeds with density 1 the cells of the `n_cells` seeds nearest to the origin; they form a
    connected cluster without holes. The outline of a cell between two junctions becomes one arc with the
    angle that preserves the area of the cell (limited to 0.9 π).

    **Arguments:**

    - `n_cells`: number of cells, at least two. (Three edges meet at each vertex; a single free cell has no
        such vertex.)
    - `key`: a key from `jax.random.key`, or an integer as its seed.
    - `lloyd_steps`: number of Lloyd iterations, which make the cells more regular.
    - `random_angles`: draw the angles of the arcs uniformly from 0 to $\pi/2$, as in the paper.
    - `inner_arcs`, `softening`: passed on to [`Tissue`][vertax.Tissue].

    **Returns:** a [`Tissue`][vertax.Tissue] with a [`Free`][vertax.Free] boundary.

    **Raises:**

    - `ValueError` for fewer than two cells, or a negative number of Lloyd iterations.
    - `TypeError` for arguments of another type, and inside `jax.jit` or `jax.vmap`, because the topology
        depends on concrete values.
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
    # Seeds in a periodic box with a margin of three cells, so that all cells are bounded.
    n_seeds = int(np.ceil((2 * np.sqrt(n_cells / np.pi) + 6) ** 2))
    box = np.sqrt(n_seeds) * np.eye(2)
    seed_key, angle_key = jax.random.split(as_key(key))
    fractions = np.asarray(jax.random.uniform(seed_key, (n_seeds, 2), dtype), float)
    seeds = (fractions[spatial_order(fractions)] - 0.5) @ box
    seeds, vertices, topology = tessellate(seeds, box, lloyd_steps)
    # The union of the Voronoi cells of the seeds in a disk is a topological disk: at each point x between a
    # seed p and the centre, the nearest seed is at least as close to the centre as p, because the circle
    # about x through p is inside the circle about the centre through p. On the ray outward from a seed
    # outside of the disk, the nearest seed is at least as far from the centre as that seed.
    chosen = np.zeros(n_seeds, bool)
    chosen[np.argsort(np.sum(seeds**2, axis=1))[:n_cells]] = True
    corners = np.repeat(vertices, 3, axis=0) + np.asarray(topology.frame) @ box
    vertices, topology, angles = _cut_out(corners, topology, chosen)
    if random_angles:
        angles = jax.random.uniform(angle_key, angles.shape, dtype, maxval=np.pi / 2)

    def build(
        vertices: Float[Array, "vertices 2"], angles: Float[Array, " edges"] | None
    ) -> Tissue:
        # The default softening depends on the areas, which depend on the angles.
        return Tissue(vertices, topology, Free(), softening, angles=angles, inner_arcs=inner_arcs)

    tissue = build(jnp.asarray(vertices, dtype), jnp.asarray(angles, dtype))
    repaired = repair_overlaps(tissue)
    return tissue if repaired is tissue else build(repaired.vertices, repaired.angles)


def _cut_out(
    corners: Float[np.ndarray, "halfedges 2"],
    topology: Topology,
    chosen: Bool[np.ndarray, " cells"],
) -> tuple[Float[np.ndarray, "vertices 2"], Topology, Float[np.ndarray, " edges"]]:
    """The cluster of the chosen cells: vertices, topology and the angles of its arcs."""
    cell, twin = np.asarray(topology.cell), np.asarray(topology.twin)
    inside = chosen[cell]
    # A vertex of two or three chosen cells is a junction and keeps its three edges. A vertex of one chosen
    # cell is inside an arc of the outline.
    junction = np.sum(inside.reshape(-1, 3), axis=1) >= 2
    start = np.flatnonzero(np.repeat(junction, 3))
    # Walk from each junction around the chosen cell on the left to the next junction, and sum the area
    # between the outline and the origin.
    start = start[inside[start]]
    following = np.asarray(topology.next)
    last, swept = start.copy(), np.zeros(len(start))
    walking = np.ones(len(start), bool)
    while walking.any():
        step = 0.5 * cross(corners[last], corners[following[last]])
        swept[walking] += step[walking]
        walking &= ~junction[twin[last] // 3]
        last = np.where(walking, following[last], last)
    chord = corners[following[last]] - corners[start]
    bulge = swept - 0.5 * cross(corners[start], chord)

    number = np.cumsum(junction) - 1
    rename = lambda h: 3 * number[h // 3] + h % 3
    n_half = 3 * int(junction.sum())
    new_twin, new_cell = np.empty(n_half, int), np.full(n_half, chosen.sum())
    vertices = np.empty((n_half // 3, 2))
    first, other = rename(start), rename(twin[last])
    new_twin[first], new_twin[other] = other, first
    new_cell[first] = (np.cumsum(chosen) - 1)[cell[start]]
    vertices[first // 3] = corners[start]
    cluster = Topology(new_twin, new_cell, np.zeros((n_half, 2), int), exterior=True)
    angles = np.zeros(cluster.n_edges)
    outline = new_cell[other] == chosen.sum()
    angle = angle_of_area(bulge[outline], np.linalg.norm(chord[outline], axis=1))
    angles[np.asarray(cluster.edge)[first[outline]]] = angle
    return vertices, cluster, angles
