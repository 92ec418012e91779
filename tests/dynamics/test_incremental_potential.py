"""What a step in time dissipates where edges flip."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

from vertax.activities import SelfPropulsion
from vertax.dissipations import EdgeViscosity, SubstrateFriction
from vertax.dynamics import evolve
from vertax.dynamics._incremental_potential import Incremental, flipped_as
from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.mesh._topology import flip_edges
from vertax.relax import Relaxation
from vertax.transitions._edge_frames import EdgeFrames


def turned(tissue, number):
    """The tissue with one edge flipped, of the same length."""
    corner = EdgeFrames(tissue)
    which = jnp.arange(tissue.n_edges) == number
    assert corner.can_flip[number]
    placed = corner.place(tissue, which, corner.across, corner.length)
    return placed.with_topology(flip_edges(tissue.topology, which))


@eqx.filter_jit
def step(before, tissue):
    resists = SubstrateFriction(2.0) + EdgeViscosity(0.5)
    energy = ShapeFactorEnergy(3.7)
    return Incremental(energy, resists, before, jnp.array(1e-6))(tissue), energy(tissue)


def test_turning_an_edge_is_free_and_moving_it_is_not():
    tissue = random_tissue(12, 3)
    for number in (4, 11):
        flipped = turned(tissue, number)
        base = flipped_as(tissue, flipped)
        np.testing.assert_allclose(base.vertices, flipped.vertices, atol=1e-12)
        with_friction, energy = step(tissue, flipped)
        np.testing.assert_allclose(with_friction, energy, rtol=1e-12)
        # Back again it is the same edge, turned around.
        again = turned(flipped, number)
        np.testing.assert_allclose(flipped_as(flipped, again).vertices, again.vertices, atol=1e-12)
    moved = tissue.with_vertices(tissue.vertices + jnp.array([0.01, 0.0]))
    with_friction, energy = step(tissue, moved)
    np.testing.assert_allclose(with_friction - energy, 24 * 1e-4 / 1e-6, rtol=1e-6)
    np.testing.assert_array_equal(flipped_as(tissue, moved).vertices, tissue.vertices)


def test_edges_that_are_pressed_together_stay_upright():
    tissue = random_tissue(12, 3)
    corner, number = EdgeFrames(tissue), 4
    which = jnp.arange(tissue.n_edges) == number
    quiet = Incremental(ShapeFactorEnergy(3.7), SubstrateFriction(1.0), tissue, jnp.array(0.1))
    driven = eqx.tree_at(lambda s: s.pressed, quiet, jnp.array(2.0), is_leaf=lambda x: x is None)

    @jax.jit
    def barrier(length):
        there = corner.place(tissue, which, corner.along, jnp.full(tissue.n_edges, length))
        return driven(there) - quiet(there)

    size = float(jnp.sqrt(tissue.areas.mean()))
    assert driven(tissue) == quiet(tissue)
    lengths = size * jnp.array([-0.001, 0.0005, 0.001, 0.0019, 0.0021])
    turning, *short, free = jax.vmap(barrier)(lengths)
    assert free == 0
    assert turning > short[0] > short[1] > short[2] > 0
    # A third of the range away it opens the edge with more than the largest force there is.
    slope = jax.grad(barrier)(0.0006 * size)
    assert slope < -2.0
    step = 1e-6 * size
    change = barrier(0.0006 * size + step) - barrier(0.0006 * size - step)
    np.testing.assert_allclose(slope, change / (2 * step), rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize(("speed", "replicate"), [(1.2, 0), (0.2, 0), (0.6, 0)])
def test_steps_of_cells_that_press_from_all_sides_come_to_an_end(speed, replicate):
    # Fluid tissues in which four cells met in points that no step could leave: the first where pushes
    # pressed such a point from all sides, the second where an edge rested at less than it flips with.
    first, noise = jax.random.split(jax.random.fold_in(jax.random.key(0), replicate))
    movie = evolve(
        periodic_voronoi(36, key=first),
        ShapeFactorEnergy(3.95),
        SubstrateFriction(1.0),
        0.5 * jnp.arange(121),
        activity=SelfPropulsion(2 * speed, 1.0),
        key=noise,
        substeps=5,
        relaxation=Relaxation(tolerance=1e-6, max_steps=500),
    )
    assert movie.num_t1 > 20
