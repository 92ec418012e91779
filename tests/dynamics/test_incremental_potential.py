"""The incremental potential: dissipation at flips, and the inversion barrier of driven tissues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_tissue

from vertax.activities import SelfPropulsion
from vertax.dissipations import EdgeViscosity, SubstrateFriction
from vertax.dynamics import evolve
from vertax.dynamics._incremental_potential import IncrementalPotential, with_flips_of
from vertax.energies import ShapeFactorEnergy
from vertax.initialise import periodic_voronoi
from vertax.relax import Relaxation
from vertax.transitions._edge_frames import EdgeFrames
from vertax.transitions._euler_operators import flip_edges


def with_flip(tissue, number):
    """The tissue with one edge flipped, at the same length."""
    corner = EdgeFrames(tissue)
    which = jnp.arange(tissue.n_edges) == number
    assert corner.can_flip[number]
    placed = corner.place(tissue, which, corner.across, corner.length)
    return placed.with_topology(flip_edges(tissue.topology, which))


@eqx.filter_jit
def step(before, tissue):
    dissipation = SubstrateFriction(2.0) + EdgeViscosity(0.5)
    energy = ShapeFactorEnergy(3.7)
    return IncrementalPotential(energy, dissipation, before, jnp.array(1e-6))(tissue), energy(
        tissue
    )


@pytest.mark.thorough
def test_flips_dissipate_nothing_and_translations_do():
    tissue = random_tissue(12, 3)
    for number in (4, 11):
        flipped = with_flip(tissue, number)
        base = with_flips_of(tissue, flipped)
        np.testing.assert_allclose(base.vertices, flipped.vertices, atol=1e-12)
        with_friction, energy = step(tissue, flipped)
        np.testing.assert_allclose(with_friction, energy, rtol=1e-12)
        # A second flip restores the edge, rotated by 180 degrees.
        again = with_flip(flipped, number)
        np.testing.assert_allclose(
            with_flips_of(flipped, again).vertices, again.vertices, atol=1e-12
        )
    moved = tissue.with_vertices(tissue.vertices + jnp.array([0.01, 0.0]))
    with_friction, energy = step(tissue, moved)
    np.testing.assert_allclose(with_friction - energy, 24 * 1e-4 / 1e-6, rtol=1e-6)
    np.testing.assert_array_equal(with_flips_of(tissue, moved).vertices, tissue.vertices)


@pytest.mark.thorough
def test_inversion_barrier_of_driven_tissues():
    tissue = random_tissue(12, 3)
    corner, number = EdgeFrames(tissue), 4
    which = jnp.arange(tissue.n_edges) == number
    passive = IncrementalPotential(
        ShapeFactorEnergy(3.7), SubstrateFriction(1.0), tissue, jnp.array(0.1)
    )
    driven = eqx.tree_at(
        lambda s: s.max_driving_force, passive, jnp.array(2.0), is_leaf=lambda x: x is None
    )

    @jax.jit
    def barrier(length):
        squeezed = corner.place(tissue, which, corner.along, jnp.full(tissue.n_edges, length))
        return driven(squeezed) - passive(squeezed)

    size = float(jnp.sqrt(tissue.areas.mean()))
    assert driven(tissue) == passive(tissue)
    lengths = size * jnp.array([-0.001, 0.0005, 0.001, 0.0019, 0.0021])
    turning, *short, free = jax.vmap(barrier)(lengths)
    assert free == 0
    assert turning > short[0] > short[1] > short[2] > 0
    # At a third of its range the barrier force exceeds the largest driving force, 2.
    slope = jax.grad(barrier)(0.0006 * size)
    assert slope < -2.0
    step = 1e-6 * size
    change = barrier(0.0006 * size + step) - barrier(0.0006 * size - step)
    np.testing.assert_allclose(slope, change / (2 * step), rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize(("speed", "replicate"), [(1.2, 0), (0.2, 0), (0.6, 0), (1.2, 2)])
def test_steps_of_fluid_active_tissues_converge(speed, replicate):
    # Regression: fluid tissues in which steps failed at four-fold vertices. In the first, active forces
    # compress such a vertex from all sides; in the second, an edge rests below the threshold of T1
    # transitions; in the last, steps that would jump across a contact were repeated.
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
