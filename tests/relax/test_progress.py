"""A relaxation that cannot come to rest ends early with the reason."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FIXED_TOPOLOGY, random_tissue

import vertax as vx
from vertax.energies import AreaElasticity, LineTension

N = 9
TENSIONS = jnp.array([0.2, -0.5])
RELAXATION = vx.Relaxation(transitions=None)


def energy_of(tissue: vx.Tissue, tension: jax.Array) -> vx.AbstractEnergy:
    return AreaElasticity(jnp.ones(N), 1.0) + LineTension(jnp.full(tissue.n_edges, tension))


def overlapping(seed: int) -> vx.Tissue:
    """A tissue of which one vertex is far from its cells."""
    tissue = random_tissue(N, seed)
    moved = tissue.with_vertices(tissue.vertices.at[0].add(2.5))
    assert moved.overlaps.any
    return moved


@pytest.mark.thorough
def test_overlaps_of_the_start_that_remain_end_the_search():
    tissue = overlapping(2)
    equilibrium = RELAXATION(tissue, energy_of(tissue, TENSIONS[1]), throw=False)
    assert equilibrium.result == vx.RESULTS.overlap
    assert equilibrium.num_steps == 100


@pytest.mark.thorough
def test_overlaps_of_the_start_may_resolve():
    tissue = overlapping(2)
    equilibrium = RELAXATION(tissue, energy_of(tissue, TENSIONS[0]))
    assert not equilibrium.tissue.overlaps.any


@pytest.mark.parametrize("seed", [0, 1])
def test_an_energy_without_minimum_ends_the_search(seed):
    tissue = random_tissue(N, seed)
    energy = energy_of(tissue, TENSIONS[1])
    equilibrium = RELAXATION(tissue, energy, throw=False)
    assert equilibrium.result == vx.RESULTS.no_progress
    assert equilibrium.num_steps <= 1000
    with pytest.raises(RuntimeError, match="its energy has no minimum"):
        RELAXATION(tissue, energy)


def test_an_energy_without_minimum_ends_the_search_if_cells_may_overlap():
    tissue = random_tissue(N, 0)
    energy = LineTension(jnp.full(tissue.n_edges, -1.0))
    equilibrium = FIXED_TOPOLOGY(tissue, energy, throw=False)
    assert equilibrium.result == vx.RESULTS.no_progress
    assert equilibrium.num_steps == 300


@pytest.mark.thorough
def test_members_of_a_batch_with_spare_slots_end_on_their_own():
    tissue = random_tissue(N - 2, 0).with_capacity(N)
    relax = lambda tension: RELAXATION(tissue, energy_of(tissue, tension), throw=False)
    batch = eqx.filter_jit(eqx.filter_vmap(relax))(TENSIONS)
    np.testing.assert_array_equal(batch.converged, [True, False])
    assert (batch.result == vx.RESULTS.no_progress)[1]
    assert batch.num_steps[1] < 2000
