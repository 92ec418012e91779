"""Free tissues for the tests, and functions of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vertax as vx


def cluster(n_cells: int, seed: int = 0, **options) -> vx.Tissue:
    return vx.initialise.free_voronoi(n_cells, key=jax.random.key(seed), **options)


def at_rest(
    tissue: vx.Tissue, *, largest_area: float, tolerance: float
) -> tuple[vx.Tissue, np.ndarray, np.ndarray]:
    """A cluster of random tensions and areas in equilibrium, its tensions and pressures."""
    n, uniform = tissue.n_cells, jax.random.uniform
    tension = uniform(jax.random.key(1), (tissue.n_edges,), minval=0.7, maxval=1.3)
    areas = uniform(jax.random.key(2), (n,), minval=0.9, maxval=largest_area)
    area = vx.energies.AreaElasticity(20.0, areas)
    relax = vx.Relaxation(tolerance=tolerance, contact_range=None)
    relaxed = relax(tissue, area + vx.energies.LineTension(tension)).tissue
    return relaxed, np.asarray(tension), np.asarray(area.pressures(relaxed))


def doublet(*, inner_arcs: bool = False, softening: float = 0.0) -> vx.Tissue:
    """Two cells, left and right of a straight interface; edges 0, 1, 2 are right arc, interface, left."""
    # At the lower vertex the right arc, the interface and the left arc leave counter-clockwise, at the
    # upper one the left arc, the interface and the right arc.
    topology = vx.Topology(
        twin=np.array([5, 4, 3, 2, 1, 0]),
        cell=np.array([1, 0, 2, 0, 1, 2]),
        frame=np.zeros((6, 2), int),
        exterior=True,
    )
    return vx.Tissue(
        jnp.array([[0.0, -0.5], [0.0, 0.5]]),
        topology,
        vx.Free(),
        softening,
        angles=jnp.full(3, 1.5).at[1].set(0.0),
        inner_arcs=inner_arcs,
    )


def angles_of(tissue: vx.Tissue) -> jax.Array:
    assert tissue.angles is not None
    return tissue.angles


def with_angles(tissue: vx.Tissue, angles: jax.Array) -> vx.Tissue:
    return tissue.with_angles(angles)


def rotated(tissue: vx.Tissue, angle: float, shift=(0.0, 0.0)) -> vx.Tissue:
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return tissue.with_vertices(jnp.asarray(np.asarray(tissue.vertices) @ turn + np.array(shift)))


def relabelled(tissue: vx.Tissue, seed: int) -> tuple[vx.Tissue, np.ndarray, np.ndarray]:
    """Renumber vertices, slots, cells and edges at random; also return the new cell and edge numbers."""
    rng, m = np.random.default_rng(seed), tissue.topology
    vertex, cell, edge = (rng.permutation(n) for n in (m.n_vertices, m.n_cells, m.n_edges))
    slot = (np.arange(3) + rng.integers(3, size=(m.n_vertices, 1))) % 3
    half_edge = (3 * vertex[:, None] + slot).ravel()  # the new number of each
    back = np.argsort(half_edge)
    topology = vx.Topology(
        half_edge[np.asarray(m.twin)][back],
        np.append(cell, m.n_cells)[np.asarray(m.cell)][back],
        np.asarray(m.frame)[back],
        edge[np.asarray(m.edge)][back],
        exterior=m.exterior,
    )
    # The directions of inner edges may change, and with them the signs of their angles.
    same = np.asarray(topology.half_edge)[edge] == half_edge[np.asarray(m.half_edge)]
    angles = np.where(same, 1, -1) * np.asarray(tissue.angles)
    new = vx.Tissue(
        tissue.vertices[np.argsort(vertex)],
        topology,
        tissue.boundary,
        tissue.softening,
        angles=angles[np.argsort(edge)],
        inner_arcs=tissue.inner_arcs,
        angle_length=tissue.angle_length,
    )
    return new, cell, edge


@eqx.filter_jit
def forces(tissue: vx.Tissue, energy: vx.AbstractEnergy) -> tuple[jax.Array, jax.Array]:
    """Derivatives of the energy with respect to vertices and angles."""
    at = lambda v, a: energy(with_angles(tissue.with_vertices(v), a))
    return jax.grad(at, argnums=(0, 1))(tissue.vertices, tissue.angles)


def outline_length(tissue: vx.Tissue) -> int:
    """Number of edges on the outline."""
    return int(np.sum(tissue.topology.on_outline))
