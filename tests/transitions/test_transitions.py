"""T1 transitions of periodic tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import edge_cell_sets, random_tissue, shape_factors, tissues
from hypothesis import given, settings, strategies as st

import vertax as vx
from vertax._base.tracing import traced
from vertax.energies import LineTension, ShapeFactorEnergy


class Opaque(vx.AbstractEnergy):
    """Wraps a local energy as one that is not local."""

    inner: vx.AbstractEnergy

    def __call__(self, tissue):
        return self.inner(tissue)


@eqx.filter_jit
def compiled_sweep(tissue, energy, rule, counts):
    return rule.sweep(tissue, energy, rule.init(tissue) if counts is None else counts)


def sweep(tissue, energy, rule, counts=None):
    # Numbers as arrays, so that other numbers do not recompile.
    return compiled_sweep(tissue, *traced((energy, rule)), counts)


def test_edges_flip_only_if_the_energy_decreases():
    # Four hexagons around a short edge. Both configurations have the same edge length, so the energies of the
    # cells decide: with large target perimeters of the two cells at its sides the edge does not flip, with
    # large ones of the two cells at its ends it does.
    tissue = vx.initialise.hexagonal(4, 4)
    edge = 5
    v, w = np.asarray(tissue.topology.edge_vertices)[edge]
    middle = 0.499 * tissue.edge_vectors[edge]
    tissue = tissue.with_configuration(tissue.vertices.at[v].add(middle).at[w].add(-middle))
    sides = np.asarray(tissue.topology.edge_cells)[edge]
    loose = jnp.full(16, 3.7).at[jnp.asarray(sides)].set(4.5)
    tight = jnp.full(16, 4.5).at[jnp.asarray(sides)].set(3.7)
    rule = vx.T1(threshold=0.01)

    kept, counts = sweep(tissue, ShapeFactorEnergy(loose), rule)
    assert counts.sum() == 0
    # Rejected flips do not move vertices.
    np.testing.assert_array_equal(kept.vertices, tissue.vertices)
    assert edge_cell_sets(kept) == edge_cell_sets(tissue)

    flipped, counts = sweep(tissue, ShapeFactorEnergy(tight), rule)
    assert counts[edge] == 1
    assert counts.sum() == 1
    assert flipped.edge_lengths[edge] == pytest.approx(0.01, rel=0.02)
    assert not set(edge_cell_sets(flipped)[edge]) & set(sides.tolist())
    # The flipped edge is perpendicular to the old one.
    assert jnp.dot(flipped.edge_vectors[edge], tissue.edge_vectors[edge]) == pytest.approx(
        0, abs=1e-9
    )
    assert flipped.areas.sum() == pytest.approx(16)
    np.testing.assert_allclose(flipped.vertices.mean(0), tissue.vertices.mean(0), atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(tissues(min_cells=5), st.floats(3.4, 4.2), st.floats(0.05, 0.5))
def test_a_sweep_preserves_all_invariants(recipe, p0, threshold):
    tissue = recipe()
    energy = ShapeFactorEnergy(p0)
    new, counts = sweep(tissue, energy, vx.T1(threshold=threshold))
    new.topology.validate()
    assert new.areas.sum() == pytest.approx(tissue.n_cells)
    changed = np.asarray(counts) > 0
    before, after = edge_cell_sets(tissue), edge_cell_sets(new)
    for e in range(tissue.n_edges):
        # Edges that do not flip keep their number and their two cells.
        assert (before[e] == after[e]) or changed[e]


@pytest.mark.parametrize("seed", range(6))
def test_local_and_total_energies_give_the_same_flips(seed):
    tissue = random_tissue(40, seed)
    energy = ShapeFactorEnergy(shape_factors(40, 3.8, 0.2, seed)) + LineTension(
        0.3 * jax.random.normal(jax.random.key(seed), (120,))
    )
    rule = vx.T1(threshold=0.2)
    a, counts_a = sweep(tissue, energy, rule)
    b, counts_b = sweep(tissue, Opaque(energy), rule)
    assert counts_a.sum() > 0
    np.testing.assert_array_equal(counts_a, counts_b)
    np.testing.assert_array_equal(a.topology.twin, b.topology.twin)
    np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-14)


def test_a_sweep_flips_several_edges():
    tissue = random_tissue(200, 0)
    _, counts = sweep(tissue, ShapeFactorEnergy(3.8), vx.T1(threshold=0.1))
    assert counts.sum() >= 5


def test_cells_keep_at_least_three_sides():
    # Large threshold and a fluid tissue: as many flips as possible.
    tissue = random_tissue(40, 3)
    energy = ShapeFactorEnergy(jax.random.uniform(jax.random.key(1), (40,), minval=2.5, maxval=5.0))
    rule = vx.T1(threshold=0.4, max_flips=1000)
    flips = 0
    for _ in range(30):
        tissue, counts = sweep(tissue, energy, rule)
        flips += int(counts.sum())
        assert tissue.neighbour_counts.min() >= 3
        tissue.topology.validate()
        shift = 0.03 * jax.random.normal(jax.random.key(flips), tissue.vertices.shape)
        tissue = tissue.with_configuration(tissue.vertices + shift)
    assert flips > 5


@pytest.mark.thorough
def test_edge_parameters_stay_with_their_edge():
    # One edge has a large tension, also after flips, so it becomes short.
    tissue = random_tissue(30, 7)
    tension = jnp.full(90, 0.1).at[17].set(2.0)
    energy = ShapeFactorEnergy(3.7) + LineTension(tension)
    relaxed = vx.equilibrate(tissue, energy)
    assert relaxed.num_t1 > 0
    assert relaxed.tissue.edge_lengths[17] < 0.01


def test_an_inverted_edge_is_a_candidate():
    tissue = vx.initialise.hexagonal(4, 4)
    v, w = np.asarray(tissue.topology.edge_vertices)[8]
    over = 0.6 * tissue.edge_vectors[8]
    inverted = tissue.with_configuration(tissue.vertices.at[v].add(over).at[w].add(-over))
    tight = jnp.full(16, 4.5).at[tissue.topology.edge_cells[8]].set(3.7)
    _, counts = sweep(inverted, ShapeFactorEnergy(tight), vx.T1(threshold=1e-3))
    assert counts[8] == 1


def test_the_number_of_flips_of_an_edge_is_bounded():
    tissue = random_tissue(40, 0)
    rule = vx.T1(threshold=0.2, max_flips=2)
    full = jnp.full(120, 2, jnp.int32)
    _, counts = sweep(tissue, ShapeFactorEnergy(3.8), rule, full)
    np.testing.assert_array_equal(counts, full)


@pytest.mark.thorough
@pytest.mark.parametrize("boundary", ["periodic", "free"])
def test_edges_of_high_tension_end_in_four_fold_vertices(boundary):
    # An edge with three times the tension of its neighbours shrinks to length 0 in both configurations (the
    # two neighbours at each end pull with at most twice their tension). It must reach equilibrium instead of
    # flipping back and forth. The solver must converge although opening such a vertex is a thousand times
    # stiffer than moving it.
    make = vx.initialise.free_voronoi if boundary == "free" else vx.initialise.periodic_voronoi
    tissue = make(16, key=jax.random.key(1))
    tense = jax.random.bernoulli(jax.random.key(2), 0.3, (tissue.n_edges,))
    energy = vx.energies.AreaElasticity(20.0, 1.0) + LineTension(jnp.where(tense, 0.9, 0.3))
    relaxed = vx.equilibrate(tissue, energy, tolerance=1e-8, max_steps=1000)
    assert int(jnp.sum(relaxed.tissue.edge_lengths < 2 * tissue.softening)) >= 3
    assert 3 <= relaxed.num_t1 < tissue.n_edges


@pytest.mark.thorough
def test_an_edge_flips_back_only_if_it_grows():
    # The cells at the ends of the edge are pulled together; whether it grows depends on its tension.
    tissue = vx.initialise.hexagonal(4, 4)
    edge = 8
    v, w = np.asarray(tissue.topology.edge_vertices)[edge]
    half = 0.5 * tissue.edge_vectors[edge] * (1 - 0.01 / tissue.edge_lengths[edge])
    short = tissue.with_configuration(tissue.vertices.at[v].add(half).at[w].add(-half))
    loose = jnp.full(16, 4.5).at[tissue.topology.edge_cells[edge]].set(3.3)
    once = jnp.zeros(tissue.n_edges, jnp.int32).at[edge].set(1)
    for tension, flips_again in ((0.0, True), (20.0, False)):
        energy = ShapeFactorEnergy(loose) + LineTension(jnp.zeros(48).at[edge].set(tension))
        for wrapped in (energy, Opaque(energy)):
            _, counts = sweep(short, wrapped, vx.T1(threshold=0.02))
            assert counts[edge] == 1, tension
            _, counts = sweep(short, wrapped, vx.T1(threshold=0.02), once)
            assert (counts[edge] == 2) == flips_again


@pytest.mark.thorough
def test_sweeps_vmap_over_tissues():
    batch = [random_tissue(40, s) for s in range(4)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    rule, energy = vx.T1(threshold=0.15), ShapeFactorEnergy(3.8)
    _, together = eqx.filter_vmap(lambda t: sweep(t, energy, rule))(stacked)
    for tissue, counts in zip(batch, together, strict=True):
        np.testing.assert_array_equal(counts, sweep(tissue, energy, rule)[1])
    assert together.sum() > 0


@pytest.mark.parametrize("options", [{"threshold": 0.0}, {"threshold": -1e-3}, {"max_flips": 0}])
def test_invalid_settings_are_rejected(options):
    with pytest.raises(ValueError, match=f"`{next(iter(options))}` must be"):
        vx.T1(**options)
