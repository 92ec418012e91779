"""T1 transitions of free tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_helpers import angles_of, cluster, doublet, outline_length, with_angles

import vertax as vx
from vertax._base.tracing import traced
from vertax.energies import LineTension, ShapeFactorEnergy


class OutlineLength(vx.AbstractEnergy):
    """The number of edges on the outline times a sign."""

    sign: float | jax.Array

    def __call__(self, tissue):
        return self.sign * jnp.sum(tissue.topology.on_outline.astype(float))


class RandomEnergy(vx.AbstractEnergy):
    """A pseudo-random function of the topology, which changes with every flip."""

    weights: jax.Array

    def __call__(self, tissue):
        return jnp.sum(self.weights[tissue.topology.twin % 97])


class Opaque(vx.AbstractEnergy):
    """Wraps a local energy as one that is not local."""

    inner: vx.AbstractEnergy

    def __call__(self, tissue):
        return self.inner(tissue)


@eqx.filter_jit
def compiled_sweep(tissue, energy, rule):
    return rule.sweep(tissue, energy, rule.init(tissue))


def sweep(tissue, energy, rule):
    # Numbers as arrays, so that other numbers do not recompile.
    return compiled_sweep(tissue, *traced((energy, rule)))


def shortened(tissue, edge, length=0.01):
    v, w = np.asarray(tissue.topology.edge_vertices)[edge]
    vector = tissue.edge_vectors[edge]
    move = 0.5 * (1 - length / jnp.linalg.norm(vector)) * vector
    return tissue.with_vertices(tissue.vertices.at[v].add(move).at[w].add(-move))


def ends(tissue):
    """The faces at the start and at the end of each edge."""
    m = tissue.topology
    h, twin, cell = np.asarray(m.half_edge), np.asarray(m.twin), np.asarray(m.cell)
    turn = lambda g: 3 * (g // 3) + (g + 1) % 3
    return cell[turn(h)], cell[turn(twin[h])]


def inner_edges_at_the_outline(tissue):
    start, end = ends(tissue)
    n = tissue.n_cells
    return np.flatnonzero(((start == n) ^ (end == n)) & ~np.asarray(tissue.topology.on_outline))


@pytest.mark.thorough
def test_an_inner_edge_can_become_an_arc_and_return():
    tissue = cluster(12, 1, lloyd_steps=3)
    rule = vx.T1(threshold=0.02)
    edge = inner_edges_at_the_outline(tissue)[0]
    tissue = shortened(with_angles(tissue, angles_of(tissue).at[edge].set(1.3)), edge)
    flipped, counts = sweep(tissue, OutlineLength(-1.0), rule)
    flipped.topology.validate()
    assert (counts[edge], counts.sum()) == (1, 1)
    assert not tissue.is_arc[edge]
    assert flipped.is_arc[edge]
    assert angles_of(flipped)[edge] == 0
    assert outline_length(flipped) == outline_length(tissue) + 1
    np.testing.assert_allclose(flipped.areas.sum(), tissue.areas.sum(), rtol=1e-2)
    others = np.arange(tissue.n_edges) != edge
    np.testing.assert_array_equal(angles_of(flipped)[others], angles_of(tissue)[others])

    again, counts = sweep(flipped, OutlineLength(1.0), vx.T1(threshold=0.021))
    again.topology.validate()
    assert (counts[edge], counts.sum()) == (1, 1)
    assert not again.is_arc[edge]
    same = lambda t: sorted(map(sorted, np.asarray(t.topology.edge_cells).tolist()))
    assert same(again) == same(tissue) != same(flipped)


def test_threshold_applies_to_the_length_of_the_arc():
    tissue = cluster(12, 1, lloyd_steps=3)
    arc = int(np.flatnonzero(tissue.is_arc)[0])
    tissue = shortened(tissue, arc)
    rule = vx.T1(threshold=0.02)
    straight = with_angles(tissue, angles_of(tissue).at[arc].set(0.1))
    assert sweep(straight, OutlineLength(1.0), rule)[1][arc] == 1
    bulging = with_angles(tissue, angles_of(tissue).at[arc].set(0.9 * np.pi))
    assert sweep(bulging, OutlineLength(1.0), rule)[1].sum() == 0


@pytest.mark.thorough
def test_flips_that_disconnect_the_tissue_are_rejected():
    # Edges with the exterior at both ends: the interface of a doublet, a bridge between two parts.
    for tissue in (doublet(), cluster(8, 1), cluster(8, 3)):
        start, end = ends(tissue)
        bridges = (start == tissue.n_cells) & (end == tissue.n_cells)
        assert bridges.any()
        _, counts = sweep(tissue, OutlineLength(-1.0), vx.T1(threshold=100.0))
        assert counts[bridges].sum() == 0
    tissue = doublet()
    for sign in (-1.0, 1.0):
        assert sweep(tissue, OutlineLength(sign), vx.T1(threshold=100.0))[1].sum() == 0


@pytest.mark.parametrize("inner_arcs", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_random_flips_preserve_all_invariants(seed, inner_arcs):
    tissue = cluster(8, seed, inner_arcs=inner_arcs)
    n_flips, least_length = 0, outline_length(tissue)
    for k in range(25):
        key = jax.random.key(100 * seed + k)
        energy = RandomEnergy(jax.random.normal(key, (97,)))
        tissue, counts = sweep(tissue, energy, vx.T1(threshold=100.0))
        tissue.topology.validate()
        n_flips += int(counts.sum())
        least_length = min(least_length, outline_length(tissue))
        # Flipped edges have length 100.
        place = jax.random.normal(key, tissue.vertices.shape)
        tissue = with_angles(tissue.with_vertices(place), 0.5 * jnp.ones(tissue.n_edges))
    assert n_flips > 8
    assert least_length >= 2


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_local_and_total_energies_give_the_same_flips(seed):
    tissue = cluster(12, seed, random_angles=True)
    tension = 0.3 * jax.random.normal(jax.random.key(seed), (tissue.n_edges,))
    energy = ShapeFactorEnergy(3.7) + LineTension(tension)
    rule = vx.T1(threshold=0.3)
    a, counts_a = sweep(tissue, energy, rule)
    b, counts_b = sweep(tissue, Opaque(energy), rule)
    assert counts_a.sum() > 0
    np.testing.assert_array_equal(counts_a, counts_b)
    np.testing.assert_array_equal(a.topology.twin, b.topology.twin)
    np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-14)


def test_cells_of_straight_clusters_keep_three_sides():
    tissue = cluster(8, 1)
    tissue = vx.Tissue(tissue.vertices, tissue.topology, vx.Free())
    for k in range(10):
        energy = RandomEnergy(jax.random.normal(jax.random.key(k), (97,)))
        before = tissue.neighbour_counts.min()
        tissue, _ = sweep(tissue, energy, vx.T1(threshold=100.0))
        tissue.topology.validate()
        assert tissue.neighbour_counts.min() >= min(3, before)
        tissue = tissue.with_vertices(jax.random.normal(jax.random.key(k), tissue.vertices.shape))


def test_edges_at_pinned_vertices_do_not_flip():
    tissue = cluster(12, 1, lloyd_steps=3)
    edge = inner_edges_at_the_outline(tissue)[0]
    tissue = shortened(tissue, edge)
    pinned = jnp.zeros(tissue.n_vertices, bool).at[tissue.topology.edge_vertices[edge, 0]].set(True)
    held = eqx.tree_at(lambda t: t.pinned, tissue, pinned, is_leaf=lambda x: x is None)
    assert sweep(tissue, OutlineLength(-1.0), vx.T1())[1].sum() == 1
    assert sweep(held, OutlineLength(-1.0), vx.T1())[1].sum() == 0


@pytest.mark.thorough
def test_sweeps_vmap_over_free_tissues():
    batch = [cluster(12, s) for s in range(4)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    rule, energy = vx.T1(threshold=0.2), OutlineLength(-1.0)
    _, together = eqx.filter_vmap(lambda t: sweep(t, energy, rule))(stacked)
    for tissue, counts in zip(batch, together, strict=True):
        np.testing.assert_array_equal(counts, sweep(tissue, energy, rule)[1])
    assert together.sum() > 0
