"""Ablation of edges and cells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

import vertax as vx
from vertax.transitions import ablate, divide

pytestmark = pytest.mark.thorough

FORCE = jax.jit(lambda t, e: -jax.grad(lambda y: e(t.with_configuration(y)))(t.configuration))


def foam(n_edges):
    tension = 0.2 + 0.1 * jnp.cos(jnp.arange(1.0 * n_edges))
    return vx.energies.AreaElasticity(1.0, 1.3) + vx.energies.LineTension(tension), tension


@pytest.mark.thorough
def test_initial_force_after_a_cut_is_the_tension_of_the_edge():
    tissue = random_tissue(9, 2, lloyd_steps=2)
    energy, tension = foam(tissue.n_edges)
    rest = vx.equilibrate(tissue, energy).tissue
    same, cut = ablate(rest, energy, edges=jnp.arange(tissue.n_edges) == 5)
    assert same is rest
    force = FORCE(rest, cut)
    ends = rest.topology.edge_vertices[5]
    along = rest.edge_vectors[5] / jnp.linalg.norm(rest.edge_vectors[5])
    np.testing.assert_allclose(force[ends[0]], -tension[5] * along, atol=1e-5)  # softened
    np.testing.assert_allclose(force[ends[1]], tension[5] * along, atol=1e-5)
    others = jnp.delete(force, ends, axis=0)
    np.testing.assert_allclose(others, 0, atol=1e-8)


def test_ablated_cells_become_one_hole_without_energy():
    tissue = random_tissue(12, 4, lloyd_steps=3).with_capacity(12)
    energy, _ = foam(tissue.n_edges)
    neighbour = int(tissue.topology.cell[tissue.topology.twin[0]])
    cells = jnp.isin(jnp.arange(12), jnp.array([int(tissue.topology.cell[0]), neighbour]))
    wounded, left = ablate(tissue, energy, cells=cells)
    wounded.topology.validate()
    assert wounded.alive.sum() == 11
    assert wounded.areas.sum() == pytest.approx(12)
    (hole,) = np.flatnonzero(cells & wounded.alive)
    assert left.cell_terms(wounded)[hole] == 0
    # Ablation of both daughters is the inverse of a division, except for collinear corners.
    parent = random_tissue(9, 2).with_capacity(10)
    change = divide(parent, 3)
    pair = jnp.isin(jnp.arange(10), jnp.array([3, 9]))
    merged, _ = ablate(change.tissue, energy=foam(30)[0], cells=pair)
    merged.topology.validate()
    areas = np.asarray(merged.areas)
    assert areas[3] + areas[9] == pytest.approx(float(parent.areas[3]), abs=1e-13)
    np.testing.assert_allclose(
        np.delete(areas, [3, 9]), np.delete(parent.areas, [3, 9]), atol=1e-13
    )


def test_holes_that_cannot_merge_are_rejected(without_type_checks):
    energy = vx.energies.AreaElasticity(1.0, 1.0)
    cluster = vx.initialise.free_voronoi(8, key=0, lloyd_steps=5).with_capacity(8)
    touching = np.asarray(cluster.topology.edge_cells)
    (inner,) = np.setdiff1d(np.arange(8), touching[(touching == 8).any(axis=1)])
    ring = np.isin(np.arange(9), touching[(touching == inner).any(axis=1)])[:8]
    ring[inner] = False
    for cells in (ring, np.ones(8, bool)):  # around a living cell, and a whole free tissue
        with pytest.raises(RuntimeError, match="but two of them cannot"):
            ablate(cluster, energy, cells=cells)
        with pytest.raises(Exception, match="but two of them cannot"):
            jax.block_until_ready(
                jax.jit(lambda t, c: ablate(t, energy, cells=c)[0])(cluster, cells)
            )


def test_removed_vertices_are_not_pinned():
    tissue = random_tissue(9, 2)
    pinned = eqx.tree_at(
        lambda t: t.pinned,
        tissue.with_capacity(9),
        jnp.ones(18, bool),
        is_leaf=lambda x: x is None,
    )
    pair = jnp.isin(jnp.arange(9), tissue.topology.edge_cells[0])
    wounded, _ = ablate(pinned, vx.energies.AreaElasticity(1.0, 1.0), cells=pair)
    np.testing.assert_array_equal(wounded.pinned, wounded.topology.alive_vertices)


def test_invalid_arguments_are_rejected(without_type_checks):
    tissue = random_tissue(6, 1)
    energy, _ = foam(tissue.n_edges)
    with pytest.raises(ValueError, match="with_capacity"):
        ablate(tissue, energy, cells=jnp.zeros(6, bool))
    with pytest.raises(ValueError, match="`edges`"):
        ablate(tissue, energy, edges=jnp.zeros(5, bool))
    with pytest.raises(TypeError, match="sum over cells"):
        ablate(tissue, vx.energies.Sum(()), edges=jnp.zeros(18, bool))  # pyright: ignore
