"""What a step in time dissipates where edges flip."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from helpers import random_tissue

from vertax.dissipations import EdgeViscosity, SubstrateFriction
from vertax.energies import ShapeFactorEnergy
from vertax.mesh._topology import flip_edges
from vertax.responses._step import Incremental, flipped_as
from vertax.transitions._t1 import EdgeFrames


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
